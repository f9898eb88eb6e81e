"""Commands that are broken off, and what is then in their folder: as before, or as after."""

import argparse
import hashlib
import json
import os
import re
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from time import monotonic
from typing import NoReturn

from l2m_gtsam.errors import L2MError
from l2m_gtsam.storage.result_set import SET_FILE, check_set
from tests.drives.fleets import CONFIG, make_place, vehicle
from tests.fuzz.cases import markdown
from tests.fuzz.corpus import make_demo
from tests.fuzz.runner import GOOD, start_command
from tests.support.command_line import l2m
from tests.worlds.study_sites import TINY_BASIN

MOST_S = 900  # of a command that nobody stops, on a machine that others use, too
OUT, HERE = "OUT", "HERE"
OLD, NEW = "old", "new"
SECONDS = re.compile(rb'"(core_)?seconds": [0-9.]+')
KEPT_ALONE = (".tiles", "cells")  # folders whose files are kept one by one
BAD = ("mixture", "next run fails", "other results", "hidden", "ends otherwise")


@dataclass(frozen=True)
class Command:
    """A command that is broken off.

    Attributes
    ----------
    name
        In the table.
    before
        Words of the run whose results are there before; empty for none.
    words
        Of the run that is broken off; ``OUT`` is its folder of results, ``HERE`` holds its inputs.
    inputs
        Files that are copied to ``HERE``: what is kept beside them counts, too.
    share
        How often it is broken off among a hundred commands.
    once
        Whether it refuses to write again what is there.
    """

    name: str
    before: tuple[str, ...]
    words: tuple[str, ...]
    inputs: tuple[Path, ...] = ()
    share: int = 100
    once: bool = False


def commands(folder: Path, demo: Path) -> list[Command]:
    """Return what is broken off; files that it needs are made in a folder.

    Most run in a small place whose map is made in a second. Tiles that are kept beside a map, and
    workers, take longer and have smaller shares.
    """
    place, bags, known = make_place(folder / "place"), folder / "bags", folder / "known"
    drive, other = (vehicle(bags / f"truck_{k}" / "day_0.bag", seed=k) for k in range(2))
    study, otherwise = folder / "basin.yaml", folder / "otherwise.yaml"
    study.write_text(TINY_BASIN.model_dump_json())
    sigma = {"position_sigma_m": {"warn": 0.011, "fail": 0.031}}
    known_prior = {"length_scale": 0.8, "signal": 8.0, "noise": 0.1}
    model = {"kind": "sliding_gp", "sliding_gp": {"hyperparameters": known_prior}}
    changed = {"qa": {"halves": False, **sigma}, "mapping": {"model": model}}
    otherwise.write_text(json.dumps({**CONFIG, **changed}))
    here, there = str(folder / "place" / "survey.bag"), ("--out", OUT)
    as_now, before = ("--config", str(place.config)), ("--config", str(otherwise))
    on_map = ("--map", f"{HERE}/map.npz")
    l2m("calibrate", drive, "--map", place.map, *as_now, "--out", known)
    calibrated = ("--calibration", str(known / "calibration.yaml"))
    calibrate = ("calibrate", str(drive), *on_map, *there)
    slam = ("slam", str(drive), *on_map, *calibrated, *there)
    build = ("map", "build", here, "--out", f"{OUT}/m.npz")
    update = ("map", "update", f"{HERE}/map.npz", str(other), *as_now, "--out", f"{OUT}/m.npz")
    copied = ("--out", f"{OUT}/copy.bag", "--despite-verdict")
    batch = ("batch", str(bags), *on_map, "--workers", "1", *there)
    basin = ("study", "basin", "--options", str(study), "--workers", "1", *there)
    whole = ("calibrate", str(demo / "calibration_mcap"), *on_map, *there)
    return [
        Command("calibrate", (*calibrate, *before), (*calibrate, *as_now), (place.map,), 20),
        Command("map build", (*build, *before), (*build, *as_now), (), 18),
        Command("map update", (*build, *before), update, (place.map,), 18),
        Command("apply", (), ("apply", str(drive), *calibrated, *copied), (), 14, once=True),
        Command("slam", (*slam, *before), (*slam, *as_now), (place.map,), 16),
        Command("batch", (*batch, *before), (*batch, *as_now), (place.map,), 5),
        Command("study", (), basin, (), 5),
        Command("calibrate, tiles kept", (), whole, (demo / "map.npz",), 4),
    ]


Files = dict[str, str]


@dataclass(frozen=True)
class Prepared:
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

    command: Command
    folder: Path
    old: Files
    new: Files
    varying: frozenset[str]
    seconds: float

    @property
    def there(self) -> Path:
        """The folder that is killed in; that of what was before lies beside it."""
        return self.folder / "there"


def prepared(command: Command, folder: Path) -> Prepared:
    """Run a command twice without a kill, and keep what was before."""
    shutil.rmtree(folder, ignore_errors=True)
    before, there = folder / "before", folder / "there"
    (before / "out").mkdir(parents=True)
    for each in command.inputs:
        shutil.copy(each, before)
    if command.before:
        complete(command.before, before)
    old, runs, begun = files(before), [], monotonic()
    for _ in range(2):
        shutil.rmtree(there, ignore_errors=True)
        shutil.copytree(before, there)
        begun = monotonic()
        complete(command.words, there)
        runs.append(files(there))
    seconds = monotonic() - begun
    shutil.copytree(there, folder / "after")
    assert runs[0] != old, "before and after are the same"
    assert runs[0].keys() == runs[1].keys()
    varying = frozenset(name for name, digest in runs[0].items() if runs[1][name] != digest)
    return Prepared(command, folder, old, runs[0], varying, seconds)


def next_run(trial: Prepared) -> tuple[str, str]:
    """Run the command to its end; return which of ``BAD`` that is, and why, or nothing."""
    is_there = trial.command.once and state(trial) == NEW
    try:
        complete(trial.command.words, trial.there)
    except RuntimeError as reason:
        if not (is_there and "exists already" in str(reason)):
            return "next run fails", str(reason)
    wrong = difference(files(trial.there), trial.new, trial.varying)
    if wrong:
        return "other results", wrong
    stay = hidden(trial.there)
    return ("hidden", ", ".join(stay)) if stay else ("", "")


def state(trial: Prepared) -> str:
    """Return whether each folder of results is as before or as after; else what is between."""
    for path in sorted(trial.there.rglob("*")):
        if path.is_file() and not _ishidden(path.relative_to(trial.there)):
            try:
                check_set(path, L2MError)  # completes, as every reader does, what was published
            except L2MError as reason:
                return str(reason)
    groups: dict[str, Files] = {}
    found = files(trial.there)
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
        elif not (wrong := difference(here, new, trial.varying)):
            states.add(NEW)
        else:
            return wrong
    return NEW if NEW in states else OLD


def _group(name: str) -> str:
    """Return the folder whose files belong together, or the file where each is alone."""
    folder = Path(name).parent
    alone = any(part.endswith(KEPT_ALONE) for part in folder.parts)
    return name if alone else folder.as_posix()


def difference(found: Files, expected: Files, varying: frozenset[str]) -> str:
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


def files(folder: Path) -> Files:
    return {
        name.as_posix(): hashlib.sha256(content(folder / name)).hexdigest()
        for name in sorted(each.relative_to(folder) for each in folder.rglob("*"))
        if not _ishidden(name) and (folder / name).is_file()
    }


def content(path: Path) -> bytes:
    """Return what a file holds, without seconds that a run took and what follows from them.

    Two runs that take the same tenth of a second look as if the time were part of the result.
    """
    if path.name == SET_FILE:  # digests are those of files that are compared themselves
        return json.dumps(sorted(json.loads(path.read_bytes())["files"])).encode()
    return SECONDS.sub(b"", path.read_bytes()) if path.suffix == ".json" else path.read_bytes()


def hidden(folder: Path) -> list[str]:
    found = []
    for where, folders, files in os.walk(folder):
        found += [str(Path(where, each)) for each in (*folders, *files) if each.startswith(".")]
    return found


def _ishidden(name: Path) -> bool:
    return any(part.startswith(".") for part in name.parts)


def start(words: Sequence[str], there: Path) -> int:
    out, log = there / "out", there.with_name("said.log")
    made = [each.replace(OUT, str(out)).replace(HERE, str(there)) for each in words]
    return start_command(made, there, log, MOST_S)


def complete(words: Sequence[str], there: Path) -> None:
    number = start(words, there)
    ended = os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
    if ended not in GOOD or ended == 2:
        said = there.with_name("said.log").read_text(errors="replace")
        raise RuntimeError(f"exit code {ended}: {said[-400:]}")


def table(found: Counter[tuple[str, str]]) -> str:
    """Return how often each command left what, in Markdown."""
    seen = dict.fromkeys(left for _, left in sorted(found))
    return markdown(found, ("command", "runs"), [*(each for each in seen if each not in BAD), *BAD])


def asked_for(what: str, usual: int, about: str) -> tuple[list[Command], argparse.Namespace]:
    """Return the commands that a command line names, and the rest of what it says."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument(f"--{what}", type=int, default=usual, dest="times")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", action="append", help="name of a command")
    parser.add_argument("--demo", type=Path, required=True, help="folder of `l2m demo`")
    parser.add_argument("--out", type=lambda text: Path(text).resolve(), required=True)
    asked = parser.parse_args()
    make_demo(asked.demo.resolve())
    shutil.rmtree(asked.out, ignore_errors=True)
    asked.out.mkdir(parents=True)
    chosen = commands(asked.out, asked.demo.resolve())
    return [each for each in chosen if not asked.only or each.name in asked.only], asked


def break_all(
    once: Callable[[Prepared, Random], tuple[str, str]],
    chosen: Sequence[Command],
    times: int,
    folder: Path,
    seed: int,
) -> Counter[tuple[str, str]]:
    """Break commands off, as often as their shares say; return how often each left what."""
    found: Counter[tuple[str, str]] = Counter()
    whole = sum(each.share for each in chosen)
    for command in chosen:
        trial = prepared(command, folder / command.name.replace(" ", "_"))
        print(f"{command.name}: {trial.seconds:.1f} s, {len(trial.new)} files", flush=True)
        for number in range(max(1, round(times * command.share / whole))):
            left, wrong = once(trial, Random(f"{seed} {command.name} {number}"))  # noqa: S311 - repeatable
            found[command.name, left] += 1
            if left in BAD:
                print(f"{number}: {command.name}: {left}: {wrong}", flush=True)
        (folder / "table.md").write_text(table(found))
    return found


def print_and_exit(found: Counter[tuple[str, str]]) -> NoReturn:
    """Print what was found, and end; with exit code 1 if any of it is bad."""
    print(table(found))
    sys.exit(int(any(left in BAD for _, left in found)))
