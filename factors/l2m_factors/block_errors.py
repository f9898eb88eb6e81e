"""What the readings of a block, those on several key poses, have in common beside their noise."""

from collections.abc import Iterator, Sequence
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


@dataclass(frozen=True)
class BlockDerivative:
    """Derivatives of the readings at some rows by a variable, shape (n, 3, .)."""

    key: int
    at: slice
    value: FloatArray


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
        self._runs, self._W = tuple(runs), whitening
        self._errors = [
            white(each.checked(at.stop - at.start), whitening[at])
            for at, each in zip(runs, errors, strict=True)
        ]
        every = [key for each in self._errors for key in each.step.keys]
        every += [key for each in self._errors if each.slow is not None for key in each.slow.keys]
        self.keys = list(dict.fromkeys(every))

    def residual(self, values: gtsam.Values) -> FloatArray:
        """Return what the errors add, before ``project``, shape (n, 3)."""
        added = np.empty((len(self._W), AXES))
        for at, each in zip(self._runs, self._errors, strict=True):
            added[at] = each.step.residual(values)
            if each.slow is not None:
                own = self._W[at] @ each.slow.residual(values)[:, :, None]
                added[at] += own[:, :, 0]
        return added

    def jacobians(self, values: gtsam.Values) -> Iterator[BlockDerivative]:
        """Yield its derivatives; those at the same rows by the same variable add up."""
        for at, each in zip(self._runs, self._errors, strict=True):
            terms = [(each.step.keys, each.step.jacobians(values))]
            if each.slow is not None:
                by_slow = [self._W[at] @ block for block in each.slow.jacobians(values)]
                terms.append((each.slow.keys, by_slow))
            for keys, blocks in terms:
                for key, block in zip(keys, blocks, strict=True):
                    yield BlockDerivative(key, at, block)

    def project(self, rows: FloatArray) -> None:
        """Write over rows, (n, 3, k), what is left of them without the common errors."""
        for at, each in zip(self._runs, self._errors, strict=True):
            if each.common.shape[1]:
                own = rows[at].reshape(len(each.common), -1)
                own -= each.common @ (each.common.T @ own)


def white(errors: ReadingErrors, whitening: FloatArray) -> ReadingErrors:
    """Return errors whose step has made its slope white."""
    return replace(errors, step=replace(errors.step, slope=whitening @ errors.step.slope))
