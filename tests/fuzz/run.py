"""Run many cases and print the table: ``python -m tests.fuzz.run --cases 10000 --out folder``."""

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tests.fuzz.cases import run_cases, table
from tests.fuzz.corpus import Sound, make_demo, quick_corpus, whole_corpus
from tests.fuzz.runner import BAD, import_commands

FILES = Path(__file__).parents[1] / "files"
EVERY = 100  # cases between two tables


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
    corpus_folder.mkdir(parents=True, exist_ok=True)
    files = FILES.resolve()
    if asked.demo is None:
        corpus = quick_corpus(corpus_folder, files)
    else:
        make_demo(asked.demo.resolve())
        whole = whole_corpus(corpus_folder, files, asked.demo.resolve())
        corpus = [each for each in whole if each.computes or not asked.computing]
    import_commands()
    run(range(asked.first, asked.first + asked.cases), corpus, asked.out)


def run(numbers: range, corpus: Sequence[Sound], out: Path) -> Counter[tuple[str, str]]:
    """Run cases; write table and failures as they come."""
    ends: Counter[tuple[str, str]] = Counter()
    peak, slowest = 0, 0.0
    for case, ended in run_cases(corpus, numbers, out / "failed"):
        ends[case.sound.kind, ended.how] += 1
        peak, slowest = max(peak, ended.peak_bytes), max(slowest, ended.cpu_s)
        if ended.how in BAD:
            print(f"{ended.how}: {case.name}: {ended.said.strip()[-200:]!r}", flush=True)
        if (case.number + 1 - numbers.start) % EVERY == 0 or case.number + 1 == numbers.stop:
            line = f"peak {peak / 2**20:.0f} MiB, slowest {slowest:.1f} s of a core\n"
            (out / "table.md").write_text(f"{table(ends)}\n{line}")
    return ends


if __name__ == "__main__":
    main()
