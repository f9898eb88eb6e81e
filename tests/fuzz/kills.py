"""Commands that are killed at random moments: what they leave, and what the next run makes of it.

``python -m tests.fuzz.kills --kills 200 --demo DEMO --out FOLDER`` kills each command in turn, by a
seed, and prints a table.
"""

import argparse
import hashlib
import json
import os
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from time import monotonic, sleep

from l2m_gtsam.errors import L2MError
from l2m_gtsam.storage.result_set import check_set
from tests.drives.fleets import make_place, vehicle
from tests.fuzz.corpus import make_demo
from tests.fuzz.runner import GOOD, import_commands, start_command
from tests.worlds.study_sites import TINY_BASIN

MOST_S = 900  # of a command that nobody kills, on a machine that others use, too
LOOK_AGAIN_S = 0.0005
OUT, HERE = "OUT", "HERE"
OLD, NEW = "old", "new"
KEPT_ALONE = (".tiles", "cells")  # folders whose files are kept one by one
BAD = ("mixture", "next run fails", "other results", "hidden")


@dataclass(frozen=True)
class Killed:
    """A command that is killed.

    Attributes
    ----------
    name
        In the table.
    before
        Words of the run whose results are there before; empty for none.
    words
        Of the run that is killed; ``OUT`` is its folder of results, ``HERE`` that of its inputs.
    inputs
        Files that are copied to ``HERE``: what is kept beside them counts, too.
    """

    name: str
    before: tuple[str, ...]
    words: tuple[str, ...]
    inputs: tuple[Path, ...] = ()


def commands(folder: Path, demo: Path) -> list[Killed]:
    """Return what is killed; files that it needs are made in a folder."""
    drive, mapping = (str(demo / f"{each}_mcap") for each in ("calibration", "mapping"))
    again = str(next(Path(mapping).glob("*.mcap")))  # in a folder it would be known already
    suite, field_map, known = demo / "suite.yaml", demo / "map.npz", demo / "calibration.yaml"
    place = make_place(folder / "place")
    bags = folder / "bags"
    for number in range(2):
        vehicle(bags / f"truck_{number}" / "day_0.bag", seed=number)
    study = folder / "basin.yaml"
    study.write_text(TINY_BASIN.model_dump_json())
    one = folder / "one.yaml"
    one.write_text(json.dumps({"qa": {"halves": False}}))
    on_map = ("--map", f"{HERE}/map.npz")
    with_known = ("--calibration", str(known))
    as_out = ("--out", OUT)
    otherwise = (*as_out, "--config", str(one))
    map_out = ("--suite", str(suite), "--out", f"{OUT}/m.npz")
    configured = ("--config", str(place.config), "--workers", "1")
    copied = ("--out", f"{OUT}/copy.mcap", "--despite-verdict")
    return [
        Killed(
            "calibrate",
            ("calibrate", drive, *on_map, *otherwise),
            ("calibrate", drive, *on_map, *as_out),
            (field_map,),
        ),
        Killed("map build", (), ("map", "build", mapping, *map_out, "--tiles")),
        Killed(
            "map update",
            ("map", "build", mapping, *map_out),
            ("map", "update", str(field_map), again, *map_out),
        ),
        Killed("apply", (), ("apply", drive, *with_known, *copied)),
        Killed(
            "batch",
            (),
            ("batch", str(bags), "--map", f"{HERE}/map.npz", *configured, *as_out),
            (place.map,),
        ),
        Killed(
            "slam",
            ("slam", drive, *on_map, *with_known, *otherwise),
            ("slam", drive, *on_map, *with_known, *as_out),
            (field_map,),
        ),
        Killed("study", (), ("study", "basin", "--options", str(study), "--workers", "1", *as_out)),
    ]


Files = dict[str, str]


@dataclass(frozen=True)
class Trial:
    """A command with the results before and after it, as folders to be copied and compared.

    Attributes
    ----------
    command
        What is run.
    folder
        Where it runs.
    old, new
        Digests of all files before and after a run that nobody kills.
    varying
        Files that differ between two such runs: they hold times.
    seconds
        That a run takes.
    """

    command: Killed
    folder: Path
    old: Files
    new: Files
    varying: frozenset[str]
    seconds: float

    @property
    def there(self) -> Path:
        """The folder that is killed in; that of what was before lies beside it."""
        return self.folder / "there"


def prepared(command: Killed, folder: Path) -> Trial:
    """Run a command twice without a kill, and keep what was before."""
    shutil.rmtree(folder, ignore_errors=True)
    before, there = folder / "before", folder / "there"
    (before / "out").mkdir(parents=True)
    for each in command.inputs:
        shutil.copy(each, before)
    if command.before:
        _complete(command.before, before)
    old, runs, begun = _files(before), [], monotonic()
    for _ in range(2):
        shutil.rmtree(there, ignore_errors=True)
        shutil.copytree(before, there)
        begun = monotonic()
        _complete(command.words, there)
        runs.append(_files(there))
    seconds = monotonic() - begun
    assert runs[0].keys() == runs[1].keys()
    varying = frozenset(name for name, digest in runs[0].items() if runs[1][name] != digest)
    return Trial(command, folder, old, runs[0], varying, seconds)


def killed(trial: Trial, random: Random) -> tuple[str, str]:
    """Kill a command once; return what it left, and what is wrong with that or the next run."""
    there = trial.there
    shutil.rmtree(there)
    shutil.copytree(trial.folder / "before", there)
    number = _start(trial.command.words, there)
    moment = random.uniform(0.0, 1.05 * trial.seconds)
    if random.random() < 0.5:
        _await(number, lambda: bool(_hidden(there)), MOST_S)
        moment = random.choice((0.0, 0.003, 0.03, 0.3)) * random.random()
    _await(number, lambda: False, moment)
    os.kill(number, signal.SIGKILL)
    ended = os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
    left = _state(trial)
    if left not in (OLD, NEW):
        return "mixture", left
    if not ended:
        left = "complete before the kill"
    elif _hidden(there):
        left = f"{left}, hidden parts"
    try:
        _complete(trial.command.words, there)
    except RuntimeError as reason:
        return "next run fails", str(reason)
    wrong = _difference(_files(there), trial.new, trial.varying)
    if wrong:
        return "other results", wrong
    hidden = _hidden(there)
    return ("hidden", ", ".join(hidden)) if hidden else (left, "")


def _state(trial: Trial) -> str:
    """Return whether each folder of results is as before or as after; else what is between."""
    for path in sorted(trial.there.rglob("*")):
        if path.is_file() and not _is_hidden(path.relative_to(trial.there)):
            try:
                check_set(path, L2MError)  # completes, as every reader does, what was published
            except L2MError as reason:
                return str(reason)
    groups: dict[str, Files] = {}
    found = _files(trial.there)
    for name in {**found, **trial.old, **trial.new}:
        groups.setdefault(_group(name), {})
    states = set()
    for group in groups:
        here, old, new = (
            {name: digest for name, digest in files.items() if _group(name) == group}
            for files in (found, trial.old, trial.new)
        )
        if here == old:
            states.add(OLD)
        elif not (wrong := _difference(here, new, trial.varying)):
            states.add(NEW)
        else:
            return wrong
    return NEW if NEW in states else OLD


def _group(name: str) -> str:
    """Return the folder whose files belong together, or the file where each is alone."""
    folder = Path(name).parent
    alone = any(part.endswith(KEPT_ALONE) for part in folder.parts)
    return name if alone else folder.as_posix()


def _difference(found: Files, expected: Files, varying: frozenset[str]) -> str:
    """Return what differs, but for the content of files that hold times."""
    names = sorted(
        name
        for name in {**found, **expected}
        if found.get(name) != expected.get(name)
        and not (name in varying and name in found and name in expected)
    )
    return ", ".join(
        f"{name} {'missing' if name not in found else 'added' if name not in expected else 'other'}"
        for name in names
    )


def _files(folder: Path) -> Files:
    return {
        name.as_posix(): hashlib.sha256((folder / name).read_bytes()).hexdigest()
        for name in sorted(each.relative_to(folder) for each in folder.rglob("*"))
        if not _is_hidden(name) and (folder / name).is_file()
    }


def _hidden(folder: Path) -> list[str]:
    found = []
    for where, folders, files in os.walk(folder):
        found += [str(Path(where, each)) for each in (*folders, *files) if each.startswith(".")]
    return found


def _is_hidden(name: Path) -> bool:
    return any(part.startswith(".") for part in name.parts)


def _start(words: Sequence[str], there: Path) -> int:
    out, log = there / "out", there.with_name("said.log")
    made = [each.replace(OUT, str(out)).replace(HERE, str(there)) for each in words]
    return start_command(made, there, log, MOST_S)


def _complete(words: Sequence[str], there: Path) -> None:
    number = _start(words, there)
    ended = os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
    if ended not in GOOD or ended == 2:
        said = there.with_name("said.log").read_text(errors="replace")
        raise RuntimeError(f"exit code {ended}: {said[-400:]}")


def _await(number: int, is_time: Callable[[], bool], most_s: float) -> None:
    """Wait until it is time, the process has ended, or so many seconds are over."""
    late = monotonic() + most_s
    while monotonic() < late and not is_time():
        if os.waitid(os.P_PID, number, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
            return
        sleep(LOOK_AGAIN_S)


def kill_all(
    chosen: Sequence[Killed], kills: int, folder: Path, seed: int
) -> Counter[tuple[str, str]]:
    """Kill commands in turn; return how often each left what."""
    found: Counter[tuple[str, str]] = Counter()
    for turn, command in enumerate(chosen):
        trial = prepared(command, folder / command.name.replace(" ", "_"))
        print(f"{command.name}: {trial.seconds:.1f} s, {len(trial.new)} files", flush=True)
        for number in range(turn, kills, len(chosen)):
            left, wrong = killed(trial, Random(seed + number))  # noqa: S311 - repeatable
            found[command.name, left] += 1
            if left in BAD:
                print(f"{number}: {command.name}: {left}: {wrong}", flush=True)
        (folder / "table.md").write_text(table(found))
    return found


def table(found: Counter[tuple[str, str]]) -> str:
    """Return how often each command left what, in Markdown."""
    commands = list(dict.fromkeys(name for name, _ in found))
    seen = dict.fromkeys(left for _, left in sorted(found))
    columns = [*(each for each in seen if each not in BAD), *BAD]
    rows = [["command", "kills", *columns], ["---"] * (len(columns) + 2)]
    for command in [*commands, "all"]:
        counts = [
            sum(n for (name, left), n in found.items() if left == each and command in (name, "all"))
            for each in columns
        ]
        rows.append([command, *map(str, (sum(counts), *counts))])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def main() -> None:
    """Kill as the command line asks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", action="append", help="name of a command")
    parser.add_argument("--demo", type=Path, required=True, help="folder of `l2m demo`")
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    make_demo(asked.demo.resolve())
    shutil.rmtree(asked.out, ignore_errors=True)
    asked.out.mkdir(parents=True)
    import_commands()
    chosen = commands(asked.out.resolve(), asked.demo.resolve())
    wanted = [each for each in chosen if not asked.only or each.name in asked.only]
    found = kill_all(wanted, asked.kills, asked.out.resolve(), asked.seed)
    print(table(found))
    sys.exit(int(any(left in BAD for _, left in found)))


if __name__ == "__main__":
    main()
