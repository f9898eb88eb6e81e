"""Residuals that are written in Python, each as a factor of its own or several as one.

GTSAM's wrapper copies all values of a graph whenever it calls a ``CustomFactor``. With a factor for
each key pose that is work of the square of their number: 18 % of a drive of 353 key poses without a
map. One factor for some successive key poses copies them once for all of these.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from l2m_factors.arguments import noise_of
from l2m_factors.field_map import FloatArray, Jacobians


@dataclass(frozen=True)
class Residual:
    """A residual that depends on some variables.

    Attributes
    ----------
    keys
        Of the variables, each once.
    size
        Number n of its components.
    error
        Returns them at values, shape (n,), and puts their derivatives by each variable into a list,
        shape (n, .) each, if it is given one.
    """

    keys: list[int]
    size: int
    error: Callable[[gtsam.Values, Jacobians], FloatArray]

    def factor(self, noise: gtsam.noiseModel.Base | None = None) -> gtsam.CustomFactor:
        """Return it as a factor; without a noise model it is white with unit variance.

        Raises
        ------
        ValueError
            The noise is not of n components.
        """
        unit = gtsam.noiseModel.Unit.Create(self.size)
        model = unit if noise is None else noise_of(noise, self.size)
        return gtsam.CustomFactor(model, self.keys, lambda _, *at: self.error(*at))

    def whitened(self, noise: gtsam.noiseModel.Gaussian) -> "Residual":
        """Return it white with unit variance."""
        root = noise.R()

        def error(values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
            e = self.error(values, jacobians)
            if jacobians is not None:
                for slot, block in enumerate(jacobians):  # GTSAM's list takes no slice
                    jacobians[slot] = root @ block
            return np.asarray(root @ e)

        return Residual(self.keys, self.size, error)


def joint_residual(residuals: Sequence[Residual]) -> Residual:
    """Return several residuals, at least one, as one.

    A factor of it connects all their variables, so they should be on nearly the same ones.
    """
    keys = list(dict.fromkeys(key for each in residuals for key in each.keys))
    slots = [[keys.index(key) for key in each.keys] for each in residuals]
    ends = np.cumsum([each.size for each in residuals]).tolist()
    rows = [slice(end - each.size, end) for end, each in zip(ends, residuals, strict=True)]

    def error(values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        if jacobians is None:
            return np.concatenate([each.error(values, None) for each in residuals])
        e, blocks = np.empty(ends[-1]), dict[int, FloatArray]()
        for each, own, at in zip(residuals, slots, rows, strict=True):
            parts = [np.empty((0, 0))] * len(own)
            e[at] = each.error(values, parts)
            for slot, part in zip(own, parts, strict=True):
                if slot not in blocks:
                    blocks[slot] = np.zeros((len(e), part.shape[1]))
                blocks[slot][at] = part
        for slot, block in blocks.items():
            jacobians[slot] = block
        return e

    return Residual(keys, ends[-1], error)
