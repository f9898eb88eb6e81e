"""What the readings of a block, those on several key poses, have in common beside their noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors.arguments import numbers
from l2m_factors.field_map import FloatArray
from l2m_factors.slow_error import AXES, SlowError
from l2m_factors.step import StepError


@dataclass(frozen=True)
class ReadingErrors:
    """What errs for n readings on a key pose alike.

    Attributes
    ----------
    common
        B of their joint whitening ``(I - B B^T) W``, shape (3 n, r).
    step
        What the error of the step to the next key pose adds to them.
    slow
        What they have of a slow error of their sensor; nothing without.
    """

    common: FloatArray
    step: StepError
    slow: SlowError | None = None

    def checked(self, count: int) -> "ReadingErrors":
        """Return a copy for so many readings; a ValueError if it is of another number of them."""
        r = np.shape(self.common)[-1:]
        common = numbers("ReadingErrors.common", self.common, (3 * count, *r))
        slow = None if self.slow is None else self.slow.checked(count)
        return ReadingErrors(common, self.step.checked(count), slow)


class BlockErrors:
    """Errors of n readings on successive key poses, white by the noise of each reading.

    Parameters
    ----------
    runs
        Which of the n are on each key pose.
    errors
        Of the readings on each.
    whitening
        For the noise of each reading alone, 1/uT, shape (n, 3, 3).

    Raises
    ------
    ValueError
        An array is of another number of readings than are on the key pose.
    """

    def __init__(
        self, runs: Sequence[slice], errors: Sequence[ReadingErrors], whitening: FloatArray
    ) -> None:
        self._count = len(whitening)
        self._steps: list[tuple[slice, StepError]] = []
        self._common: list[tuple[slice, FloatArray]] = []
        self._by_slow: list[tuple[slice, int, FloatArray]] = []  # which, a key, and (n, 3, 3)
        for at, each in zip(runs, errors, strict=True):
            own, W = each.checked(at.stop - at.start), whitening[at]
            self._steps.append((at, replace(own.step, slope=W @ own.step.slope)))
            self._common += [(at, own.common)] if own.common.shape[1] else []
            if own.slow is not None:
                shares = zip(own.slow.keys, own.slow.shares.T, strict=True)
                self._by_slow += [(at, key, share[:, None, None] * W) for key, share in shares]
        of_steps = [key for _, step in self._steps for key in step.keys]
        self.keys = list(dict.fromkeys([*of_steps, *(key for _, key, _ in self._by_slow)]))

    def residual(self, values: gtsam.Values) -> FloatArray:
        """Return what the errors add, before ``project``, shape (n, 3)."""
        added = np.empty((self._count, AXES))
        for at, step in self._steps:
            added[at] = step.residual(values)
        for at, key, block in self._by_slow:
            added[at] += block @ values.atVector(key)
        return added

    def added(
        self, derivatives: dict[int, FloatArray], values: gtsam.Values
    ) -> dict[int, FloatArray]:
        """Return derivatives of the n readings by variables, (n, 3, .), with those of the errors.

        Those given are changed.
        """
        parts = [
            (at, *each)
            for at, step in self._steps
            for each in zip(step.keys, step.jacobians(values), strict=True)
        ]
        for at, key, block in [*parts, *self._by_slow]:
            if key not in derivatives:
                derivatives[key] = np.zeros((self._count, AXES, block.shape[2]))
            derivatives[key][at] += block
        return derivatives

    def project(self, rows: FloatArray) -> None:
        """Write over rows, (n, 3, k), what is left of them without the common errors."""
        for at, common in self._common:
            own = rows[at].reshape(len(common), -1)
            own -= common @ (common.T @ own)
