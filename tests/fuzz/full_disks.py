"""Disks that are full in the middle of a command: what is left, and what the next run makes of it.

``python -m tests.fuzz.full_disks --disks 20 --demo DEMO --out FOLDER``, as whoever may mount.
"""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random

from tests.fuzz.trials import (
    NEW,
    OLD,
    Prepared,
    asked_for,
    break_all,
    hidden,
    next_run,
    print_and_exit,
    start,
    state,
)

PAGE = 4096  # that a small file takes
ENOUGH = 1 << 29
MENDABLE = 2


def may_mount(folder: Path) -> bool:
    """Return whether a small file system can be laid over a folder."""
    try:
        with small_disk(folder, 1 << 16):
            return True
    except (OSError, subprocess.CalledProcessError):
        return False


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[None]:
    """Lay an empty file system of so many bytes over a folder; it is in memory."""
    folder.mkdir(parents=True, exist_ok=True)
    _run("mount", "-t", "tmpfs", "-o", f"size={size}", "l2m", str(folder))
    try:
        yield
    finally:
        _run("umount", "--lazy", str(folder))  # workers may end a moment later


def _run(*words: str) -> None:
    subprocess.run([str(shutil.which(words[0])), *words[1:]], check=True, capture_output=True)


def filled(trial: Prepared, random: Random) -> tuple[str, str]:
    """Let the disk get full once; return what was left, and what is wrong with it."""
    there, before = trial.there, trial.folder / "before"
    shutil.rmtree(there, ignore_errors=True)
    at_first = _taken(before)
    # New results are written beside old ones, which then go.
    results = _taken(trial.folder / "after" / "out")
    more = max(_taken(trial.folder / "after") - at_first, results)
    # Half of the time what is written last, the results, is what finds no room.
    room = random.randrange(more) if random.random() < 0.5 else more - random.randrange(results)
    with small_disk(there, at_first + room + PAGE):
        shutil.copytree(before, there, dirs_exist_ok=True)
        number = start(trial.command.words, there)
        ended = os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
        said = there.with_name("said.log").read_text(errors="replace").strip()
        last_line = said.splitlines()[-1] if said else ""
        if ended == MENDABLE and "No space left" not in last_line:
            return "ends otherwise", last_line
        if ended not in (0, 1, MENDABLE) or "Traceback" in said:
            return "ends otherwise", f"{ended}: {said[-400:]}"
        if stay := hidden(there):
            return "hidden", ", ".join(stay)
        left = state(trial)
        if left not in (OLD, NEW):
            return "mixture", f"{ended}: {left}"
        _run("mount", "-o", f"remount,size={ENOUGH}", str(there))
        wrong, why = next_run(trial)
    return (wrong, why) if wrong else (f"{left}, exit code {ended}", "")


def _taken(folder: Path) -> int:
    """Return the bytes that a folder takes on a disk of pages."""
    sizes = [each.stat().st_size if each.is_file() else PAGE for each in folder.rglob("*")]
    return sum(-(-size // PAGE) * PAGE for size in sizes)


def main() -> None:
    """Fill as the command line asks."""
    chosen, asked = asked_for("disks", 20, __doc__)
    print_and_exit(break_all(filled, chosen, asked.times, asked.out, asked.seed))


if __name__ == "__main__":
    main()
