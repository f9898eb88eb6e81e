"""Commands that are killed at random moments: what they leave, and what the next run makes of it.

``python -m tests.fuzz.kills --kills 200 --demo DEMO --out FOLDER`` kills each command in turn, by a
seed, and prints a table.
"""

import os
import shutil
import signal
from collections.abc import Callable
from random import Random
from time import monotonic, sleep

from tests.fuzz.trials import (
    MOST_S,
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


def main() -> None:
    """Kill as the command line asks."""
    chosen, asked = asked_for("kills", 200, __doc__)
    print_and_exit(break_all(killed, chosen, asked.times, asked.out, asked.seed))


if __name__ == "__main__":
    main()
