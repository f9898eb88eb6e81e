"""Where names are written beside dots: over no other name, over few dots, inside of the picture.

Each name has a line to its dot, so that it is clear whose it is where dots are close together.
Boxes are in points: lower and upper corner, shape (..., 2, 2).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.qa.report.svg import SMALL, short_name

BEHIND = 2.0  # points: dots that are closer are one to the eye
LETTER, LINE = 0.7 * SMALL, 1.4 * SMALL  # points, about: how wide a letter is, and a line high
DOT = 8.0  # points from the middle of a dot to the edge of a usual ellipse
MOST_NAMES = 4  # of one label
NEAR, FAR, STEPS = 13.0, 130.0, 12  # points from a dot to its name, and how many between are tried
TURNS = 16  # directions that are tried, the first to the right and upwards
# What is bad about a place for a name, beside an area in square points that is over a dot.
OVER, OUTSIDE, CROSSED, LONG = 100.0, 20.0, 60.0, 1.5  # areas, a line crossed, a point of length
ALONG = np.linspace(0.25, 1.0, 4)  # places of a line that are looked at


def _offsets() -> FloatArray:
    """Return offsets from a dot that are tried, the shortest first, shape (K, 2)."""
    angles = np.pi / 4 + 2 * np.pi * np.arange(TURNS) / TURNS
    around = np.column_stack([np.cos(angles), np.sin(angles)])
    return np.concatenate([size * around for size in np.linspace(NEAR, FAR, STEPS)])


OFFSETS = _offsets()


@dataclass(frozen=True, eq=False)
class Label:
    """Names beside a dot.

    Attributes
    ----------
    at
        Of the dot, points, shape (2,).
    names
        Of all that are there.
    offset
        From there to where they are written, points, shape (2,).
    """

    at: FloatArray
    names: tuple[str, ...]
    offset: FloatArray

    @property
    def side(self) -> tuple[int, int]:
        """Where they are: left (-1), right (1) or in the middle, and below, above or beside."""
        across, up = _sides(self.offset[None])[0].astype(int)
        return int(across), int(up)

    @property
    def lines(self) -> list[str]:
        """What is written; of many names the first ones, and how many there are."""
        shown = [*map(short_name, self.names)]
        if len(shown) <= MOST_NAMES:
            return shown
        return [*shown[: MOST_NAMES - 1], f"and {len(shown) - MOST_NAMES + 1} others"]

    def boxes(self, offsets: FloatArray) -> FloatArray:
        """Return about where it would be written, with offsets (K, 2), shape (K, 2, 2)."""
        extent = np.array([LETTER * max(map(len, self.lines)), LINE * len(self.lines)])
        low = self.at + offsets + 0.5 * (_sides(offsets) - 1) * extent
        return np.stack([low, low + extent], axis=1)

    def joined(self, other: "Label") -> "Label":
        """Return one label for the names of both."""
        return replace(self, names=self.names + other.names)


def placed(labels: Sequence[Label], dots: FloatArray, frame: FloatArray) -> list[Label]:
    """Return labels beside their dots; where there is no room for each, some are joined.

    Parameters
    ----------
    labels
        One for each dot.
    dots
        All that are drawn, points, shape (N, 2).
    frame
        The picture, a box.
    """
    left = _apart(labels)
    marks = np.stack([dots - DOT, dots + DOT], axis=1)
    while True:
        done: list[Label] = []
        for label in left:
            written = _boxes(done)
            costs = _costs(label, done, written, marks, frame)
            best = replace(label, offset=OFFSETS[int(np.argmin(costs))])
            covered = np.flatnonzero(_shared(_boxes([best]), written)[0] > 0)
            if len(covered):
                first = next(each for each in left if each.at is done[covered[0]].at)
                left = [each for each in left if each not in (first, label)]
                left.append(first.joined(label))
                break
            done.append(best)
        else:
            return done


def _apart(labels: Sequence[Label]) -> list[Label]:
    """Return one label for all names of dots that lie on each other."""
    apart: list[Label] = []
    for label in labels:
        near = [k for k, each in enumerate(apart) if np.abs(each.at - label.at).max() < BEHIND]
        if near:
            apart[near[0]] = apart[near[0]].joined(label)
        else:
            apart.append(label)
    return apart


def _sides(offsets: FloatArray) -> FloatArray:
    """Return to which side of their ends names are written, of each axis -1, 0 or 1, (K, 2)."""
    return np.asarray(np.round(1.2 * offsets / np.linalg.norm(offsets, axis=1, keepdims=True)))


def _boxes(labels: Sequence[Label]) -> FloatArray:
    return np.concatenate(
        [np.empty((0, 2, 2)), *(each.boxes(each.offset[None]) for each in labels)]
    )


def _costs(
    label: Label, done: Sequence[Label], written: FloatArray, marks: FloatArray, frame: FloatArray
) -> FloatArray:
    """Return how bad each offset of a label is: over another name is worse than over dots."""
    boxes = label.boxes(OFFSETS)
    outside = np.prod(boxes[:, 1] - boxes[:, 0], axis=1) - _shared(boxes, frame[None])[:, 0]
    ends = np.stack([np.broadcast_to(label.at, OFFSETS.shape), label.at + OFFSETS], axis=1)
    others = np.array([[each.at, each.at + each.offset] for each in done]).reshape(-1, 2, 2)
    crossed = _cross(ends, others) | _under(ends, written) | _under(others, boxes).T
    return np.asarray(
        OVER * _shared(boxes, written).sum(axis=1)
        + _shared(boxes, marks).sum(axis=1)
        + OUTSIDE * outside
        + CROSSED * crossed.sum(axis=1)
        + LONG * np.linalg.norm(OFFSETS, axis=1)
    )


def _shared(some: FloatArray, others: FloatArray) -> FloatArray:
    """Return the areas that boxes, K and W, have in common, shape (K, W)."""
    high = np.minimum(some[:, None, 1], others[None, :, 1])
    low = np.maximum(some[:, None, 0], others[None, :, 0])
    return np.asarray(np.prod(np.maximum(high - low, 0.0), axis=2))


def _under(lines: FloatArray, boxes: FloatArray) -> BoolArray:
    """Return which lines, (K, 2, 2) from end to end, pass below which boxes, shape (K, W)."""
    start, step = lines[:, None, 0], (lines[:, 1] - lines[:, 0])[:, None]
    places = (start + ALONG[:, None] * step)[:, None]
    inside = (boxes[None, :, None, 0] < places) & (places < boxes[None, :, None, 1])
    return np.asarray(np.any(np.all(inside, axis=3), axis=2))


def _cross(some: FloatArray, others: FloatArray) -> BoolArray:
    """Return which lines, (K, 2, 2) and (W, 2, 2) from end to end, cross, shape (K, W)."""
    a, b, c, d = some[:, None, 0], some[:, None, 1], others[None, :, 0], others[None, :, 1]

    def turn(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
        one, two = q - p, r - p
        return np.asarray(one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0])

    return np.asarray((turn(a, b, c) * turn(a, b, d) < 0) & (turn(c, d, a) * turn(c, d, b) < 0))
