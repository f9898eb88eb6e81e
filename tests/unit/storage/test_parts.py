"""Parts: hidden while they are written, held, and swept when nobody holds them."""

import subprocess
import sys
from multiprocessing import get_context
from pathlib import Path

import pytest

from l2m_gtsam.errors import OutputError
from l2m_gtsam.storage.files import atomic_path
from l2m_gtsam.storage.parts import SUFFIX, only_one, part_file, part_folder, sweep

KILLED = """
import os, signal, sys
from pathlib import Path
from l2m_gtsam.storage.parts import part_file, part_folder
with part_file(Path(sys.argv[1])) as part, part_folder(Path(sys.argv[1])) as folder:
    part.write_text("half")
    (folder / "half").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def hidden(folder: Path) -> list[str]:
    return sorted(each.name for each in folder.iterdir() if each.name.startswith("."))


def test_what_a_killed_run_left_goes_with_the_next_of_that_name(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", KILLED, str(tmp_path / "a.npz")], check=False)
    assert len(hidden(tmp_path)) == 2
    with atomic_path(tmp_path / "b.npz") as part:
        part.write_text("whole")
    assert len(hidden(tmp_path)) == 2  # of another name
    with atomic_path(tmp_path / "a.npz") as part:
        part.write_text("whole")
    assert not hidden(tmp_path)
    assert (tmp_path / "a.npz").read_text() == "whole"


def test_what_somebody_writes_stays(tmp_path: Path) -> None:
    with part_file(tmp_path / "a") as first, part_folder(tmp_path / "a") as folder:
        (folder / "inside").write_text("x")
        with part_file(tmp_path / "a") as second:
            assert first.exists()
            assert second.exists()
            sweep(tmp_path / "a")
            assert (folder / "inside").exists()
    assert not hidden(tmp_path)


@pytest.mark.parametrize(
    "name",
    [".a.npz.part", ".a.npz.12345678.part.x", ".b.12345678.part", "a.npz", ".a.npz.1234567z.part"],
)
def test_files_of_others_stay(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    sweep(tmp_path / "a.npz")
    assert (tmp_path / name).read_text() == "mine"


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("mine")
    (tmp_path / f".a.12345678{SUFFIX}").symlink_to(precious)
    sweep(tmp_path / "a")
    assert precious.read_text() == "mine"


def _other(folder: str) -> str:
    try:
        with only_one(Path(folder)):
            return "held"
    except OutputError as error:
        return str(error)


def test_a_folder_is_held_by_one_process(tmp_path: Path) -> None:
    with get_context("spawn").Pool(1) as pool:
        with only_one(tmp_path), only_one(tmp_path):  # the same process may again
            assert "another run is writing its results there" in pool.apply(
                _other, (str(tmp_path),)
            )
        assert pool.apply(_other, (str(tmp_path),)) == "held"
