"""How a command ends when it does not end well: one last line, and an exit code."""

import errno
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import current_thread, main_thread
from types import FrameType

import typer

from l2m_gtsam.errors import L2MError
from l2m_gtsam.text import shown

USER, FAULT, SIGNAL = 2, 70, 128  # exit codes: 70 is that of sysexits.h for internal errors
LOST = "standard output: cannot be written: "
# Files of results name themselves when they cannot be written.
UNWRITTEN = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stopped(BaseException):
    """A signal asked to stop; no handler of errors takes it for one."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class OutputLostError(L2MError):
    """What a command printed did not arrive."""


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Turn signals into ``Stopped``, so that what is half done is cleared away; the first alone."""
    if current_thread() is not main_thread():
        yield
        return

    def stop(number: int, _: FrameType | None) -> None:
        for each in SIGNALS:
            signal.signal(each, signal.SIG_IGN)
        raise Stopped(number)

    before = {each: signal.signal(each, stop) for each in SIGNALS}
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def flush_output() -> None:
    """Have all that was printed arrive.

    Raises
    ------
    OutputLostError
        It cannot: the disk that it goes to is full.
    """
    try:
        sys.stdout.flush()
    except BrokenPipeError:  # whoever reads has seen enough
        _forget_output()
    except (OSError, ValueError) as error:
        _forget_output()
        reason = getattr(error, "strerror", None) or error
        raise OutputLostError(f"{LOST}{reason}") from error


def last_line(error: BaseException) -> int:
    """Print what ended a command, and return its exit code."""
    text, code = _told(error)
    with suppress(OSError, ValueError):
        typer.echo(f"l2m: {shown(' '.join(text.split()))}", err=True)
    return code


def _told(error: BaseException) -> tuple[str, int]:
    if isinstance(error, Stopped):
        name = signal.Signals(error.number).name
        done = "results that were not complete are not written"
        return f"stopped by {name}; {done}", SIGNAL + error.number
    if isinstance(error, L2MError):
        return str(error), USER
    if isinstance(error, BrokenPipeError):
        return "standard output: closed before all was printed", USER
    if isinstance(error, MemoryError):
        return "not enough memory; give a shorter drive or a smaller map", USER
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        what = LOST if not where and error.errno in UNWRITTEN else ""
        return f"{where}{what}{error.strerror or error}", USER
    what = f"{type(error).__name__}: {error}"
    return f"a fault of this program, please report it with what --debug shows: {what}", FAULT


def _forget_output() -> None:
    """Leave nothing for the interpreter to write at its end, which would complain."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
