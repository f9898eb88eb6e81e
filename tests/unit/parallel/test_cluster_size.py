"""How many processes a computation starts: each takes seconds of imports."""

from contextlib import suppress
from typing import NoReturn

import pytest

from l2m_gtsam.errors import ClusterError
from l2m_gtsam.parallel import cluster
from l2m_gtsam.parallel.cluster import ClusterOptions, Work, computed

WORK: Work[int, int, int] = Work(place=int, prepare=int, task=lambda key, _: key)


@pytest.mark.parametrize(("workers", "tasks", "started"), [(8, 3, [3]), (2, 3, [2]), (4, 0, [])])
def test_no_more_processes_than_tasks(
    monkeypatch: pytest.MonkeyPatch, workers: int, tasks: int, started: list[int]
) -> None:
    asked: list[int] = []

    def counted(options: ClusterOptions) -> NoReturn:
        asked.append(options.workers)
        raise ClusterError("counted, not started")

    monkeypatch.setattr(cluster, "connected", counted)
    with suppress(ClusterError):
        assert list(computed(WORK, range(tasks), ClusterOptions(workers=workers))) == []
    assert asked == started
