"""Studies on one process, on many, on a running cluster, after losses and after restarts."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from l2m_gtsam.errors import ClusterError, ConfigError
from l2m_gtsam.parallel.cluster import ClusterOptions
from l2m_gtsam.studies import run as study_run
from l2m_gtsam.studies.run import STUDY_FILE, run_study
from tests.support.inline_study import run_inline
from tests.support.one_process import computed_here
from tests.support.toy_study import TOY, ToyOptions, ToySummary

ROOT = Path(__file__).parents[3]
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "factors")])}


def run(
    out: Path, options: ToyOptions, workers: int = 1, scheduler: str | None = None
) -> ToySummary:
    cluster = ClusterOptions(workers=workers, scheduler=scheduler)
    return run_study(TOY, options, out, cluster, lambda *_: None, "toy").summary


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> ToySummary:
    return run_inline(TOY, ToyOptions(), tmp_path_factory.mktemp("one"))


@pytest.fixture(autouse=True)
def _workers_find_the_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])


def counted(log: Path) -> dict[str, int]:
    lines = log.read_text().split()
    return {key: lines.count(key) for key in lines}


def test_two_workers_give_the_digits_of_one_and_one_that_is_lost_loses_nothing(
    tmp_path: Path, expected: ToySummary
) -> None:
    log, out = tmp_path / "log", tmp_path / "out"
    options = ToyOptions(log=str(log), deadly="cell-3")
    assert run(out, options, workers=2) == expected
    assert counted(log)["cell-3"] == 2
    assert TOY.page(expected) in (out / "toy.md").read_text()
    assert json.loads((out / STUDY_FILE).read_text())["summary"]["mean"] == expected.mean


def test_only_missing_cells_are_computed(
    tmp_path: Path, expected: ToySummary, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study_run, "computed", computed_here)
    log = tmp_path / "log"
    run_inline(TOY, ToyOptions(cells=4), tmp_path / "out")
    assert run(tmp_path / "out", ToyOptions(log=str(log))) == expected
    assert set(counted(log)) == {"cell-4", "cell-5"}


def test_a_killed_study_goes_on(
    tmp_path: Path, expected: ToySummary, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, log = tmp_path / "out", tmp_path / "log"
    program = (
        "import sys; from pathlib import Path\n"
        "from tests.support.toy_study import TOY, ToyOptions\n"
        "from l2m_gtsam.parallel.cluster import ClusterOptions\n"
        "from l2m_gtsam.studies.run import run_study\n"
        "if __name__ == '__main__':\n"
        "    options = ToyOptions(seconds=0.5, log=sys.argv[2])\n"
        "    run_study(TOY, options, Path(sys.argv[1]), ClusterOptions(workers=1),\n"
        "              lambda *_: None, 'toy')\n"
    )
    script = tmp_path / "toy.py"
    script.write_text(program)
    started = subprocess.Popen(
        [sys.executable, str(script), str(out), str(log)],
        env=ENVIRONMENT,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    cells = out / "cells"
    deadline = time.monotonic() + 60
    while not list(cells.glob("cell-*.json")):
        assert time.monotonic() < deadline
        assert started.poll() is None
        time.sleep(0.05)  # between looks: a run shows finished cells by files alone
    os.killpg(started.pid, signal.SIGKILL)
    started.wait()
    before = {path.stem for path in cells.glob("cell-*.json")}
    assert before
    assert len(before) < len(expected.values)
    log.unlink()
    monkeypatch.setattr(study_run, "computed", computed_here)
    assert run(out, ToyOptions(log=str(log))) == expected
    assert not before & set(counted(log))


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """A scheduler and a worker of its own, on loopback, stopped afterwards."""
    file = tmp_path / "scheduler.json"
    quiet = {"env": ENVIRONMENT, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    where = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(file)]
    dask = [sys.executable, "-m", "distributed.cli"]
    begin = [[f"{dask[2]}.dask_scheduler", "--port", "0"]]
    begin += [[f"{dask[2]}.dask_worker", "--no-nanny", "--nthreads", "1"]]
    commands = [[*dask[:2], *command, *where] for command in begin]
    started = [subprocess.Popen(command, **quiet) for command in commands]  # type: ignore[call-overload]
    deadline = time.monotonic() + 60
    while not file.exists() or not file.read_text():
        assert time.monotonic() < deadline
        time.sleep(0.05)  # between looks: the scheduler writes its address to a file
    yield json.loads(file.read_text())["address"]
    for process in reversed(started):
        process.terminate()
        process.wait()


def test_a_running_cluster_gives_the_same_digits(
    tmp_path: Path, scheduler: str, expected: ToySummary
) -> None:
    assert re.match(r"tcp://127\.0\.0\.1:\d+", scheduler)
    assert run(tmp_path / "out", ToyOptions(), scheduler=scheduler) == expected


def test_a_scheduler_that_is_not_there_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("l2m_gtsam.parallel.cluster.CONNECT_S", 0.5)
    with pytest.raises(ClusterError, match=r"^--scheduler tcp://127\.0\.0\.1:1: "):
        run(tmp_path, ToyOptions(), scheduler="tcp://127.0.0.1:1")


def test_a_folder_holds_one_study(tmp_path: Path) -> None:
    run_inline(TOY, ToyOptions(), tmp_path)
    with pytest.raises(ConfigError, match="other options"):
        run(tmp_path, ToyOptions(seed=2))


def test_a_broken_cell_is_named(tmp_path: Path) -> None:
    run_inline(TOY, ToyOptions(), tmp_path)
    (tmp_path / "cells" / "cell-2.json").write_text("{")
    with pytest.raises(ConfigError, match=r"cell-2\.json"):
        run(tmp_path, ToyOptions())
