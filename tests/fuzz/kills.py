"""Commands that are killed at random moments: what they leave, and what the next run makes of it.

``python -m tests.fuzz.kills --kills 200 --demo DEMO --out FOLDER`` kills each command in turn, by a
seed, and prints a table.
"""

import os
import shutil
import signal
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from time import monotonic, sleep

from tests.fuzz.trials import (
    BAD,
    MOST_S,
    NEW,
    OLD,
    Command,
    Prepared,
    asked_for,
    hidden,
    next_run,
    prepared,
    start,
    state,
    table,
    told,
)

LOOK_AGAIN_S = 0.0005


def killed(trial: Prepared, random: Random) -> tuple[str, str]:
    """Kill a command once; return what it left, and what is wrong with that or the next run."""
    there = trial.there
    shutil.rmtree(there)
    shutil.copytree(trial.folder / "before", there)
    number = start(trial.command.words, there)
    moment = random.uniform(0.0, 1.05 * trial.seconds)
    if random.random() < 0.5:
        _await(number, lambda: bool(hidden(there)), MOST_S)
        moment = random.choice((0.0, 0.003, 0.03, 0.3)) * random.random()
    _await(number, lambda: False, moment)
    os.kill(number, signal.SIGKILL)
    ended = os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
    left = state(trial)
    if left not in (OLD, NEW):
        return "mixture", left
    if not ended:
        left = "complete before the kill"
    elif hidden(there):
        left = f"{left}, hidden parts"
    wrong, why = next_run(trial)
    return (wrong, why) if wrong else (left, "")


def _await(number: int, is_time: Callable[[], bool], most_s: float) -> None:
    """Wait until it is time, the process has ended, or so many seconds are over."""
    late = monotonic() + most_s
    while monotonic() < late and not is_time():
        if os.waitid(os.P_PID, number, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
            return
        sleep(LOOK_AGAIN_S)  # between looks: what a process has written is seen in files alone


def kill_all(
    chosen: Sequence[Command], kills: int, folder: Path, seed: int
) -> Counter[tuple[str, str]]:
    """Kill commands by their shares; return how often each left what."""
    found: Counter[tuple[str, str]] = Counter()
    whole = sum(each.share for each in chosen)
    for command in chosen:
        trial = prepared(command, folder / command.name.replace(" ", "_"))
        print(f"{command.name}: {trial.seconds:.1f} s, {len(trial.new)} files", flush=True)
        for number in range(round(kills * command.share / whole)):
            left, wrong = killed(trial, Random(f"{seed} {command.name} {number}"))  # noqa: S311 - repeatable
            found[command.name, left] += 1
            if left in BAD:
                print(f"{number}: {command.name}: {left}: {wrong}", flush=True)
        (folder / "table.md").write_text(table(found))
    return found


def main() -> None:
    """Kill as the command line asks."""
    chosen, asked = asked_for("kills", 200, __doc__)
    told(kill_all(chosen, asked.times, asked.out, asked.seed))


if __name__ == "__main__":
    main()
