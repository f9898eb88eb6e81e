"""BLAS has one thread inside, and afterwards what the caller gave it."""

from collections.abc import Callable, Iterator
from threading import Barrier, Thread
from typing import Any

import pytest
import scipy.linalg  # noqa: F401 - brings a BLAS of its own
from threadpoolctl import threadpool_info, threadpool_limits

from l2m_gtsam.calibration import calibrate
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.mapping import map_building, suite_calibration
from l2m_gtsam.parallel.threads import in_threads, one_blas_thread, side_by_side
from l2m_gtsam.planning import plan
from l2m_gtsam.qa import evaluate, scene
from l2m_gtsam.slam import exploration, localisation, record
from l2m_gtsam.validation import validate

GIVEN = 2
ENTRIES = (
    evaluate.evaluate,
    scene.scene_of,
    calibrate.calibrate,
    calibrate.calibrated,
    exploration.explore,
    localisation.localise,
    map_building.compare_recordings,
    map_building.map_recordings,
    map_building.suite_readings,
    map_building.update_map,
    plan.plan,
    evaluate.compared_drives,
    evaluate.compared_halves,
    record.localisation_record,
    suite_calibration.calibrate_suite,
    validate.validate,
)


@pytest.fixture(autouse=True)
def given() -> Iterator[None]:
    """What a caller has set: more than one thread."""
    with threadpool_limits(GIVEN, user_api="blas"):
        yield


def blas_threads() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


def test_one_thread_inside_and_those_of_before_afterwards() -> None:
    assert blas_threads() == {GIVEN}
    with one_blas_thread():
        assert blas_threads() == {1}
        with one_blas_thread():
            assert blas_threads() == {1}
        assert blas_threads() == {1}
    assert blas_threads() == {GIVEN}


def test_an_exception_restores_them() -> None:
    @one_blas_thread()
    def fails() -> None:
        assert blas_threads() == {1}
        raise ValueError("wrong")

    with pytest.raises(ValueError, match="wrong"):
        fails()
    assert blas_threads() == {GIVEN}


def test_work_in_threads_inside_and_outside() -> None:
    def found(_: int) -> set[int]:
        return blas_threads()

    assert in_threads(found, range(3)) == [{1}] * 3
    assert blas_threads() == {GIVEN}
    with one_blas_thread():
        assert in_threads(found, range(3)) == [{1}] * 3
        assert blas_threads() == {1}
    assert blas_threads() == {GIVEN}


def test_two_callers_at_once_leave_the_setting_as_it_was() -> None:
    """The first to enter leaves before the second, which saw what the first had set."""
    both, first_left = Barrier(2), Barrier(2)

    def first() -> None:
        with one_blas_thread():
            both.wait(10)
        first_left.wait(10)

    def second() -> None:
        with one_blas_thread():
            both.wait(10)
            first_left.wait(10)

    threads = [Thread(target=each) for each in (first, second)]
    for each in threads:
        each.start()
    for each in threads:
        each.join(10)
    assert blas_threads() == {GIVEN}


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda each: each.__name__)
def test_public_functions_compute_with_one_thread(entry: Callable[..., Any]) -> None:
    """Whatever they first ask of their arguments, they ask inside of the limit."""
    seen: list[set[int]] = []

    class Watched:
        def __getattr__(self, name: str) -> Any:
            seen.append(blas_threads())
            raise LookupError(name)

        def __iter__(self) -> Iterator[Any]:
            seen.append(blas_threads())
            raise LookupError

        def __len__(self) -> int:
            seen.append(blas_threads())
            raise LookupError

    count = entry.__wrapped__.__code__.co_argcount if hasattr(entry, "__wrapped__") else 5
    with pytest.raises(LookupError):
        entry(*[Watched() for _ in range(count)])
    assert seen == [{1}]
    assert blas_threads() == {GIVEN}


def test_a_number_of_threads_that_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("L2M_THREADS", "two")
    with pytest.raises(ConfigError, match="L2M_THREADS: 'two' is not a number of threads"):
        in_threads(abs, [1])


def test_two_pieces_of_work_run_at_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("L2M_THREADS", "2")
    both = Barrier(2, timeout=10)  # each waits for the other

    def worded() -> str:
        both.wait()
        return "first"

    def counted() -> int:
        both.wait()
        return 2

    assert side_by_side(worded, counted) == ("first", 2)

    def failing() -> int:
        raise ValueError("second")

    with pytest.raises(ValueError, match="second"):
        side_by_side(lambda: 1, failing)
