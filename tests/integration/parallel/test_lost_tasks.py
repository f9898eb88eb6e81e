"""Tasks that kill their workers: reported where that is wanted, and nobody else is blamed."""

import logging
import os
from collections.abc import Iterator
from pathlib import Path
from time import sleep

import dask
import distributed  # its configuration is loaded before a part of it is changed
import pytest

from l2m_gtsam.errors import ClusterError, NoRoomError
from l2m_gtsam.parallel import cluster
from l2m_gtsam.parallel.cluster import ClusterOptions, Work, computed

ROOT = Path(__file__).parents[3]
KILLER, DEADLY_PLACE = 3, 100


@pytest.fixture(scope="module", autouse=True)
def _workers_find_the_tests() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(ROOT / "factors")]))
        yield


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """A scheduler with a worker, which starts again whenever a task kills it: that takes seconds.

    A task is given up when it kills one worker.
    """
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        distributed.LocalCluster(
            n_workers=1,
            threads_per_worker=1,
            host=cluster.LOOPBACK,
            dashboard_address=f"{cluster.LOOPBACK}:0",
            silence_logs=logging.CRITICAL,
        ) as running,
    ):
        yield running.scheduler_address


def place(key: int) -> int:
    return key // DEADLY_PLACE * DEADLY_PLACE


def prepare(place: int) -> int:
    if place == DEADLY_PLACE:
        os._exit(1)
    return 10


def task(key: int, prepared: int) -> str:
    if key == KILLER:
        os._exit(1)
    return f"{key + prepared}"


def lost(key: int, reason: str) -> str:
    return f"{key}: {reason}"


def test_a_killer_is_lost_and_nobody_else(scheduler: str) -> None:
    """With one failure allowed to none, all that wait on the worker are given up with it."""
    keys = [1, KILLER, 2, 4, DEADLY_PLACE, DEADLY_PLACE + 1]
    options = ClusterOptions(scheduler=scheduler)
    found = dict(computed(Work(place, prepare, task, lost), keys, options))
    assert {key: found[key] for key in (1, 2, 4)} == {1: "11", 2: "12", 4: "14"}
    for key in (KILLER, DEADLY_PLACE, DEADLY_PLACE + 1):
        assert found[key].startswith(f"{key}: every worker that began it died; give ")


def test_without_a_word_for_it_a_killer_ends_all(scheduler: str) -> None:
    options = ClusterOptions(scheduler=scheduler)
    with pytest.raises(ClusterError, match=r"^3: every worker that began it died"):
        list(computed(Work(place, prepare, task), [KILLER], options))


def test_a_scheduler_without_workers_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 2)
    with distributed.LocalCluster(
        n_workers=0, host=cluster.LOOPBACK, dashboard_address=f"{cluster.LOOPBACK}:0"
    ) as empty:
        options = ClusterOptions(scheduler=empty.scheduler_address)
        with pytest.raises(ClusterError) as error:
            list(computed(Work(place, prepare, task, lost), [1], options))
    told = str(error.value)
    assert told.startswith(f"--scheduler {empty.scheduler_address}: has no workers; start some: ")
    assert "\n" not in told


def folder_of(key: tuple[int, Path]) -> Path:
    return key[1]


def as_it_is(folder: Path) -> Path:
    return folder


def written(key: tuple[int, Path], folder: Path) -> int:
    """Leave a file when it begins and one when it ends; the second of them ends all."""
    (folder / f"{key[0]}.begun").touch()
    if key[0] == 1:
        raise NoRoomError("no room")
    if (folder / "1.begun").exists():
        sleep(5.0)  # longer than the four seconds that Dask waits before it kills a worker
    (folder / f"{key[0]}.ended").touch()
    return key[0]


def test_what_runs_ends_when_a_task_ends_all(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    keys = [(k, tmp_path) for k in range(12)]
    with pytest.raises(NoRoomError, match="no room"):
        list(computed(Work(folder_of, as_it_is, written), keys, ClusterOptions(workers=1)))
    begun, ended = ({each.stem for each in tmp_path.glob(f"*.{how}")} for how in ("begun", "ended"))
    assert begun - ended == {"1"}
    # In whatever order they are begun: one may wait in the worker while the error travels.
    when = {each.stem: each.stat().st_mtime_ns for each in tmp_path.glob("*.begun")}
    assert sum(each > when["1"] for each in when.values()) <= 1
    assert capfd.readouterr().err == ""
