"""Run many cases and print the table: ``python -m tests.fuzz.run --cases 10000 --out folder``."""

import argparse
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from shutil import rmtree

from tests.fuzz.cases import case_of, ended, table
from tests.fuzz.corpus import make_demo, quick_corpus, whole_corpus
from tests.fuzz.runner import BAD
from tests.fuzz.sound import Sound

FILES = Path(__file__).parents[1] / "files"
JOURNAL = "ends.jsonl"


@dataclass(frozen=True)
class Line:
    """How a case ended, as it is kept."""

    number: int
    kind: str
    how: str
    cpu_s: float
    peak_bytes: int


def main() -> None:
    """Run the cases that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--demo", type=Path, help="folder of `l2m demo`, for commands that compute")
    parser.add_argument("--computing", action="store_true", help="of a demonstration's files alone")
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    corpus_folder = (asked.out / "corpus").resolve()
    rmtree(corpus_folder, ignore_errors=True)
    corpus_folder.mkdir(parents=True)
    files = FILES.resolve()
    if asked.demo is None:
        corpus = quick_corpus(corpus_folder, files)
    else:
        make_demo(asked.demo.resolve())
        whole = whole_corpus(corpus_folder, files, asked.demo.resolve())
        corpus = [each for each in whole if each.computes or not asked.computing]
    run(range(asked.first, asked.first + asked.cases), corpus, asked.out)


def run(numbers: range, corpus: Sequence[Sound], out: Path) -> tuple[Counter[tuple[str, str]], str]:
    """Run the cases that a folder does not hold yet; return counts, and what they took at most.

    Ends are written as they come, so that a run that was stopped goes on. What fails is kept.
    """
    out.mkdir(parents=True, exist_ok=True)
    journal = out / JOURNAL
    ends = {each.number: each for each in _read(journal)}
    with journal.open("a") as file:
        for number in numbers:
            if number in ends:
                continue
            case = case_of(corpus, number)
            found = ended(case, out / "failed")
            ends[number] = Line(
                number, case.sound.kind, found.how, round(found.cpu_s, 3), found.peak_bytes
            )
            file.write(json.dumps(asdict(ends[number])) + "\n")
            file.flush()
            if found.how in BAD:
                print(f"{found.how}: {case.name}: {found.said.strip()[-200:]!r}", flush=True)
    done = [ends[number] for number in numbers]
    peak = max(each.peak_bytes for each in done) / 2**20
    slowest = max(each.cpu_s for each in done)
    most = f"peak {peak:.0f} MiB beside the program, slowest {slowest:.1f} s of a core"
    took = f"{len(done):,} cases, {most}"
    counts = Counter((each.kind, each.how) for each in done)
    (out / "table.md").write_text(f"{took}\n\n{table(counts)}")
    return counts, took


def _read(journal: Path) -> list[Line]:
    if not journal.exists():
        return []
    # The last line may be cut.
    whole = journal.read_text().split("\n")[:-1]
    return [Line(**json.loads(each)) for each in whole]


if __name__ == "__main__":
    main()
