"""The methods of Table I on one drive, from one start or from many."""

from collections.abc import Callable
from time import process_time

import numpy as np
from scipy.linalg import polar

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.solve.closed_form import ClosedFormOptions, Method
from l2m_gtsam.studies.magyc_peer import magyc_peer, magyc_python
from l2m_gtsam.studies.methods import MethodResult, as_published, two_step

OURS, NAIVE, MAGYC = "one-key", "naive peer", "magyc"
HARMONIC, SLIDING, THINNED, NO_MAP = "harmonic", "sliding_gp", "thinned GP", "none"

Solver = Callable[[Readings, QueryableMap, FloatArray], FloatArray]
"""From the readings of one sensor, a map and a start (3,) to t, C row by row and H, (15,)."""


def in_two_steps(method: Method) -> Solver:
    """Return the alternation of a closed form with the translation graph."""

    def solve(readings: Readings, field_map: QueryableMap, t_start: FloatArray) -> FloatArray:
        inner = ClosedFormOptions(method=method)
        return two_step(readings, field_map, t_start, inner)

    return solve


OTHERS: dict[str, Solver] = {
    "OLS": in_two_steps(Method.OLS),
    "RRTLS": in_two_steps(Method.RRTLS),
    "w-RRTLS as published": as_published,
    "w-RRTLS corrected": in_two_steps(Method.W_RRTLS),
}


def from_each(solve: Callable[[FloatArray], FloatArray], t_start: FloatArray) -> MethodResult:
    """Return where a method ends from each start, shape (N, 3)."""
    begin = process_time()
    ends = np.array([solve(t) for t in t_start])
    return MethodResult(ends, len(t_start), (process_time() - begin) / len(t_start))


def magyc(readings: Readings, C: FloatArray) -> MethodResult:
    """Return magyc's estimate of H on one drive; it finds no place, and C only up to a turn.

    It needs the turn rates along the chip's axes, which follow from the true C, shape (3, 3).

    Raises
    ------
    PeerError
        It has no environment, or fails.
    """
    found = magyc_peer(readings, np.asarray(polar(C)[0]), magyc_python())
    return MethodResult(np.append(np.full(12, np.nan), found.H)[None], 1, found.seconds)
