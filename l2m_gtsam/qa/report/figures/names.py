"""Where names are written beside dots: over no other name, over few dots, inside of the picture."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.report.svg import SMALL, short_name

BEHIND = 12.0  # points: names of dots that are closer would cover each other
LETTER, LINE = 0.7 * SMALL, 1.4 * SMALL  # points, about: how wide a letter is, and a line high
GAP = np.array([8.0, 5.0])  # points from a dot to its name
DOT = 4.0  # points from the middle of a dot to its edge
MOST_NAMES = 4  # of one label
# Where a name may be, from its dot: to the right and upwards if nothing else is there.
SIDES = ((1, 1), (-1, 1), (1, -1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1))


@dataclass(frozen=True)
class TextBox:
    """A rectangle in points: lower and upper corner, shape (2,)."""

    low: FloatArray
    high: FloatArray

    @property
    def area(self) -> float:
        """Square points."""
        return float(np.prod(self.high - self.low))

    def shared(self, other: "TextBox") -> float:
        """Return the area that both cover."""
        overlap = np.minimum(self.high, other.high) - np.maximum(self.low, other.low)
        return float(np.prod(np.maximum(overlap, 0.0)))


@dataclass(frozen=True, eq=False)
class Label:
    """Names beside a dot.

    Attributes
    ----------
    at
        Of the dot, points, shape (2,).
    names
        Of all that are there.
    side
        Where they are written: left (-1), right (1) or in the middle, and below, above or beside.
    """

    at: FloatArray
    names: tuple[str, ...]
    side: tuple[int, int] = SIDES[0]

    @property
    def lines(self) -> list[str]:
        """What is written; of many names the first ones, and how many there are."""
        shown = [*map(short_name, self.names)]
        if len(shown) <= MOST_NAMES:
            return shown
        return [*shown[: MOST_NAMES - 1], f"and {len(shown) - MOST_NAMES + 1} others"]

    @property
    def box(self) -> TextBox:
        """About where it is written."""
        extent = np.array([LETTER * max(map(len, self.lines)), LINE * len(self.lines)])
        side = np.array(self.side)
        low = self.at + side * GAP + 0.5 * (side - 1) * extent
        return TextBox(low, low + extent)

    def joined(self, other: "Label") -> "Label":
        """Return one label for the names of both."""
        return replace(self, names=self.names + other.names)


def placed(labels: Sequence[Label], dots: FloatArray, frame: TextBox) -> list[Label]:
    """Return labels beside their dots; those that would be written over each other are joined.

    Parameters
    ----------
    labels
        One for each dot.
    dots
        All that are drawn, points, shape (N, 2).
    frame
        The picture.
    """
    left = _apart(labels)
    marks = [TextBox(each - DOT, each + DOT) for each in dots]
    while True:
        done: list[Label] = []
        for label in left:
            written = [each.box for each in done]
            best = min(
                (replace(label, side=side) for side in SIDES),
                key=lambda each: _cost(each.box, written, marks, frame),
            )
            covered = [each for each in done if each.box.shared(best.box) > 0]
            if covered:
                first = next(each for each in left if each.at is covered[0].at)
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


def _cost(
    box: TextBox, written: Sequence[TextBox], marks: Sequence[TextBox], frame: TextBox
) -> float:
    """Return how bad a place for a name is: over another is worse than over dots or outside."""
    over = sum(box.shared(each) for each in written)
    hidden = sum(box.shared(each) for each in marks)
    return 100 * over + hidden + box.area - box.shared(frame)
