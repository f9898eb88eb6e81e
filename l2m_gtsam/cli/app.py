"""The command line: ``l2m``. Parsing and printing only; the work is done in ``batch``.

Heavy modules are imported inside the commands, so that ``--help`` answers at once, and below the
first bar, so that it is seen while they load. A command that does not end well prints one last line
and has an exit code.
"""

import ctypes
import errno
import gc
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import current_thread, main_thread
from types import FrameType
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from l2m_gtsam.cli.calibration import batch, calibrate, config, inspect, plan
from l2m_gtsam.cli.maps import map_app
from l2m_gtsam.cli.results import apply, export, report, validate
from l2m_gtsam.cli.simulation import demo, simulate, study
from l2m_gtsam.cli.slam import slam
from l2m_gtsam.cli.terminal import shown_notices
from l2m_gtsam.errors import L2MError
from l2m_gtsam.text import shown

ORDER = (
    *("inspect", "config", "map", "plan", "calibrate", "report", "validate", "export", "apply"),
    *("batch", "slam", "demo", "simulate", "study"),
)
"""Of use."""
USER, FAULT, SIGNAL = 2, 70, 128  # exit codes: 70 is that of sysexits.h for internal errors
LOST = "standard output: cannot be written: "
# Click's UsageError; newer releases of Typer have Click inside, where it has no public name.
UsageError: Any = typer.BadParameter.__mro__[1]
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
    if isinstance(error, UsageError):
        return _misused(error), USER
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


def _misused(error: Any) -> str:
    """Return what is wrong with a command line, and where it says what is right."""
    what = str(error.format_message()).rstrip(".")
    command = error.ctx.command_path if error.ctx else "l2m"
    return f"{what[:1].lower()}{what[1:]} (`{command} --help` shows all options)"


def _forget_output() -> None:
    """Leave nothing for the interpreter to write at its end, which would complain."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


class InOrder(TyperGroup):
    """The commands in the order of use."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return their names."""
        names = super().list_commands(ctx)
        return sorted(names, key=ORDER.index)


app = typer.Typer(
    cls=InOrder,
    name="l2m",
    help="Calibrate magnetometers against a LiDAR from one drive through a mapped field.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.add_typer(map_app, name="map")
for _command in (
    *(inspect, config, plan, calibrate, report, validate, export, apply),
    *(batch, slam, demo, simulate, study),
):
    app.command()(_command)


DEBUG = "--debug"

ALLOCATED = 100_000  # objects, after which Python looks for cycles among them: 700 by default
# Parameters of glibc's mallopt, and sizes in bytes.
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
KEPT, MAPPED = (1 << 31) - 1, 1 << 30


def main() -> None:
    """Run the command line; whatever ends it is one last line and an exit code.

    2 is what a user can mend, 70 a fault of this program, 128 and the number of a signal a stop.
    """
    # Blocks of a few hundred readings are too small for threads, which then only wait for each
    # other; has to be set before numpy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _suit_large_arrays()
    arguments = [argument for argument in sys.argv[1:] if argument != DEBUG]
    try:
        with stopped_by_signals(), shown_notices():
            _run(arguments)
    except (Stopped, Exception) as error:
        if DEBUG in sys.argv[1:]:
            raise
        sys.exit(last_line(error))


def _suit_large_arrays() -> None:
    """Have memory managed for few large arrays in place of many small objects.

    glibc gives each array of megabytes back to the system, which clears every page that it hands
    out again: a tenth of a calibration's time. Looking for cycles took a twentieth.
    """
    gc.set_threshold(ALLOCATED)
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library
        return
    mallopt(TRIM_THRESHOLD, KEPT)
    mallopt(MMAP_THRESHOLD, MAPPED)


def _run(arguments: list[str]) -> None:
    """Run a command; what it printed has arrived when it returns or ends."""
    try:
        ended = app(arguments, prog_name="l2m", standalone_mode=False)
    except UsageError as error:
        if str(error.format_message()):
            raise
        ended = USER  # a group without a command has shown its help
    finally:
        flush_output()
    sys.exit(ended)


def _version(wanted: bool) -> None:
    """Print the version and end."""
    if wanted:
        from importlib.metadata import version

        typer.echo(f"l2m {version('l2m-gtsam')}")
        raise typer.Exit


@app.callback()
def options(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error (at any place).")
    ] = False,
) -> None:
    """Calibrate magnetometers against a LiDAR from one drive through a mapped field."""
