"""Colours that stand for numbers, and the bar that says which stands for which."""

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.qa.report.panel import Limits

COLOURS = 48  # that a picture has: as many paths, however many points


def colours(name: str) -> list[str]:
    """Return the colours of a matplotlib colour map, from the lowest to the highest."""
    return [to_hex(each) for each in colormaps[name](np.linspace(0, 1, COLOURS))]


def shades(values: FloatArray, limits: Limits) -> IntArray:
    """Return which colour stands for each value; those beyond the limits have the last."""
    low, high = limits
    share = (values - low) / (high - low or 1.0)
    return np.asarray(np.clip((share * COLOURS).astype(int), 0, COLOURS - 1))
