"""Kernels that were just compiled and kernels read from the cache give the same bits."""

import os
import subprocess
import sys
from pathlib import Path


def test_the_first_run_on_a_machine_gives_the_digits_of_the_next(
    tmp_path: Path, repository: Path
) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    environment["PYTHONPATH"] = os.pathsep.join([str(repository), str(repository / "factors")])

    def digits() -> str:
        command = [sys.executable, "-m", "tests.support.kernel_digits"]
        run = subprocess.run(
            command, cwd=repository, env=environment, capture_output=True, text=True, check=True
        )
        return run.stdout

    first = digits()
    assert len(first.splitlines()) == 4
    assert any(tmp_path.rglob("*.nbc"))  # compiled, and kept
    assert digits() == first
