"""Cases by number: which file, which change, which command; and their table."""

import shutil
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random

from tests.fuzz.runner import BAD, GOOD, MORE_CPU_S, MOST_CPU_S, Ended, run_case
from tests.fuzz.sound import CASE, OUT, Sound

OUT_NAME = "out"
QUICK_TURNS = 5  # of files that are read in a moment, for one of a file that takes seconds


@dataclass(frozen=True)
class Case:
    """A changed file and a command that reads it.

    Attributes
    ----------
    number
        With the corpus it says everything else.
    """

    number: int
    sound: Sound
    change: str
    words: tuple[str, ...]
    data: bytes

    @property
    def name(self) -> str:
        """What it is, in a line."""
        return f"{self.number}: {self.sound.kind}, {self.change}: l2m {' '.join(self.words)}"


def case_of(corpus: Sequence[Sound], number: int) -> Case:
    """Return a case; kinds take turns."""
    random = Random(number)  # noqa: S311 - repeatable, not secret
    quick = [each for each in corpus if not each.computes]
    turns = [*(quick * QUICK_TURNS), *(each for each in corpus if each.computes)]
    sound = turns[number % len(turns)]
    name = random.choice(list(sound.changes))
    words = random.choice(sound.commands)
    try:
        data = sound.changes[name](sound.path.read_bytes(), random)
    except (ValueError, TypeError, OverflowError, RecursionError):
        # What cannot be written as this format cannot be met in it.
        name, data = "bytes", sound.changes["bytes"](sound.path.read_bytes(), random)
    return Case(number, sound, name, words, data)


def ended(case: Case, keep: Path | None = None) -> Ended:
    """Run a case, and keep its input if it ends as nothing may.

    Parameters
    ----------
    case
        What is run.
    keep
        Folder for inputs that failed.
    """
    with tempfile.TemporaryDirectory(prefix="l2m_fuzz_") as name:
        folder = Path(name).resolve()
        path, out = folder / case.sound.path.name, folder / OUT_NAME
        path.write_bytes(case.data)
        for each in case.sound.beside:
            shutil.copy(each, folder)
        # As parts of words, too: `OUT.npz` is a name that begins as results do.
        words = [
            str(path)
            if word == CASE
            else str(out) + word[len(OUT) :]
            if word.startswith(OUT)
            else word
            for word in case.words
        ]
        most_s = MORE_CPU_S if case.sound.computes else MOST_CPU_S
        found = run_case(words, folder, out, most_s)
        if found.how in BAD and keep is not None:
            kept = keep / f"{case.number}-{found.how.replace(' ', '_')}"
            kept.mkdir(parents=True, exist_ok=True)
            (kept / path.name).write_bytes(case.data)
            (kept / "said.txt").write_text(f"{case.name}\n{found}\n{found.said}")
        return found


def table(ends: Counter[tuple[str, str]]) -> str:
    """Return how many cases of each kind ended how, as a table in Markdown."""
    return markdown(ends, ("file", "cases"), [*GOOD.values(), *BAD])


def markdown(ends: Counter[tuple[str, str]], head: tuple[str, str], columns: Sequence[str]) -> str:
    """Return how often each kind ended how, with a sum; ``head`` names the kinds and the sums."""
    kinds = list(dict.fromkeys(kind for kind, _ in ends))
    rows = [[*head, *columns], ["---"] * (len(columns) + 2)]
    for kind in [*kinds, "all"]:
        counts = [
            sum(
                count
                for (each, how), count in ends.items()
                if how == column and kind in (each, "all")
            )
            for column in columns
        ]
        rows.append([kind, *(f"{each:,}" for each in (sum(counts), *counts))])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"
