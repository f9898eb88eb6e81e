"""Whether a source is a dipole, a bar that stands or one that lies.

A source that is looked for has to earn each of its parameters (Schwarz 1978): what is not found yet
looks like the length of a bar as well. With all sources found, each one's shape is decided again by
its evidence. What a length costs then is how much narrower readings make it than it was beforehand,
so that a length which they leave open stays open, and widens the sigma of the moment.
"""

import numpy as np

from l2m_gtsam.maps.sources.found_sources import FoundSources, price, refined
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.maps.sources.source import SourceShape

FIRST_HALF_M = (0.3, 0.8)  # where the length of a bar is started, near a dipole and elsewhere
# Bars stand upright or lie: components of the axis that are zero stay so.
STANDING = np.array([[0.0, 0.0, 1.0]])
LYING = np.array([[0.92, 0.39, 0.0], [-0.39, 0.92, 0.0]])
NO_LENGTH = np.zeros((1, 3))
ROUNDS = 3  # of deciding on all shapes: sources beside each other share a field
BARE_MENTION = 2.0  # evidence that is not worth more (Kass and Raftery 1995, 3.2)


def best_of(rows: MarginalRows, found: FoundSources, starts: list[SourceShape]) -> FoundSources:
    """Return the best refinement of sources and one more, a dipole or a bar."""
    dipole = min((refined(rows, (*found.shapes, each)) for each in starts), key=_left)
    best, before = dipole, (*dipole.shapes[:-1],)
    for axes in (STANDING, LYING):
        near, elsewhere = FIRST_HALF_M
        bars = [
            refined(rows, (*before, dipole.shapes[-1].with_half_axis(near * axis))) for axis in axes
        ]
        bars += [
            refined(rows, (*found.shapes, starts[0].with_half_axis(elsewhere * axis)))
            for axis in axes
        ]
        bar = min(bars, key=_left)
        if best.left - bar.left > price(rows, bar.parameters - best.parameters):
            best = bar
    return best


def reshaped(rows: MarginalRows, found: FoundSources) -> FoundSources:
    """Return the same sources, each with the shape that has most evidence beside the others."""
    for _ in range(ROUNDS):
        before = found
        for k in range(len(found)):
            other = max(_of_other_shapes(rows, found, k), key=_evidence)
            found = other if other.evidence > found.evidence + BARE_MENTION else found
        if found is before:
            break
    return found


def _of_other_shapes(rows: MarginalRows, found: FoundSources, k: int) -> list[FoundSources]:
    """Return sources of which one has another shape than it has."""
    half_axis = found.shapes[k].half_axis
    shape_of_now = STANDING if half_axis[2] else LYING if half_axis.any() else NO_LENGTH
    others = [axes for axes in (NO_LENGTH, STANDING, LYING) if axes is not shape_of_now]
    start = FIRST_HALF_M[0] * np.concatenate(others)
    shapes = found.shapes
    return [
        refined(rows, (*shapes[:k], shapes[k].with_half_axis(each), *shapes[k + 1 :]))
        for each in start
    ]


def _left(found: FoundSources) -> float:
    return found.left


def _evidence(found: FoundSources) -> float:
    return found.evidence
