"""Independent pieces of linear algebra, which leaves Python alone while it computes."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from os import cpu_count, environ
from threading import Lock, local
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

from l2m_gtsam.errors import ConfigError

MOST_THREADS = 8
THREADS = "L2M_THREADS"
"""Environment variable: how many threads a process may use; all cores where it is not set."""

In = TypeVar("In")
Out = TypeVar("Out")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Give BLAS one thread inside, and afterwards what it had; to be used as a decorator, too.

    Blocks of a few hundred readings are too small for threads in BLAS, which would only wait for
    each other: with them a calibration took seven times as long.
    """
    _LIMIT.enter()
    try:
        yield
    finally:
        _LIMIT.leave()


def in_threads(work: Callable[[In], Out], items: Iterable[In]) -> list[Out]:
    """Return the results in the order of the items; BLAS has one thread meanwhile.

    Raises
    ------
    ConfigError
        If L2M_THREADS is not a number of threads.
    """
    pieces = list(items)
    threads = min(_allowed(environ.get(THREADS)), MOST_THREADS, len(pieces))
    with one_blas_thread():
        if threads <= 1:
            return [work(piece) for piece in pieces]
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(work, pieces))


def _allowed(text: str | None) -> int:
    if not text:
        return cpu_count() or 1
    try:
        return int(text)
    except ValueError:
        raise ConfigError(
            f"{THREADS}: {text!r} is not a number of threads; accepted: a whole number"
        ) from None


def side_by_side(first: Callable[[], In], second: Callable[[], Out]) -> tuple[In, Out]:
    """Return the results of two pieces of work that are done at the same time, as ``in_threads``.

    It is worth while where one of them leaves Python alone: GTSAM never does.
    """
    work: tuple[Callable[[], Any], ...] = (first, second)
    one, other = in_threads(lambda each: each(), work)
    return one, other


class _Limit:
    """Who is inside of the limit, and what BLAS had before the first came.

    With some libraries the number of threads is one of the process, with others each thread of
    Python has its own. So each thread restores what it saw, and the last one what the first saw.
    """

    def __init__(self) -> None:
        self._own = local()
        self._lock = Lock()
        self._inside = 0
        self._before: list[int] = []

    def enter(self) -> None:
        depth = getattr(self._own, "depth", 0)
        if depth == 0:
            with self._lock:
                self._own.before = _numbers()
                if self._inside == 0:
                    self._before = self._own.before
                self._inside += 1
                _set_numbers([1] * len(self._own.before))
        self._own.depth = depth + 1

    def leave(self) -> None:
        self._own.depth -= 1
        if self._own.depth == 0:
            with self._lock:
                self._inside -= 1
                _set_numbers(self._own.before if self._inside else self._before)


_LIMIT = _Limit()


def _numbers() -> list[int]:
    return [each.num_threads for each in _libraries()]


def _set_numbers(numbers: list[int]) -> None:
    for library, number in zip(_libraries(), numbers, strict=True):
        library.set_num_threads(number)


@lru_cache(maxsize=1)
def _libraries() -> list[Any]:
    """Return the BLAS libraries of this process: looking for them takes longer than a task."""
    import scipy.linalg  # noqa: F401 - has a BLAS of its own, found only once it is loaded

    return ThreadpoolController().select(user_api="blas").lib_controllers  # type: ignore[no-any-return]
