"""Windows of a survey beside their most likely field, and changes of its sensors along it.

What a survey says of a change along it, a clock that drifts or an offset that jumps, follows from
the same slopes as what it says of its sensors, by one scoring step of all.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.mapping.options import SuiteCalibrationOptions
from l2m_gtsam.mapping.suite_likelihood import (
    SuiteWindow,
    WindowSlopes,
    likelihood_at,
    window_slopes,
)
from l2m_gtsam.mapping.suite_solver import likeness, prior_information
from l2m_gtsam.mapping.suite_windows import SuiteWindows, windows_over
from l2m_gtsam.maps.harmonic.structure import NO_SOURCES


@dataclass(frozen=True)
class WindowScore:
    """What a window says of p parameters: information, shape (p, p), and slope, shape (p,)."""

    information: FloatArray
    slope: FloatArray


@dataclass(frozen=True)
class SeenWindow:
    """A window of a survey, with its slopes, and that of its likelihood by S sensors, (16 S,)."""

    window: SuiteWindow
    at: WindowSlopes
    slope: FloatArray

    def score(self, columns: FloatArray) -> WindowScore:
        """Return what it says of all sensors, then of k changes.

        ``columns`` are the derivatives of its N residuals by these, shape (N, 3, k).
        """
        changes = -np.einsum("ni,nij->j", self.at.residual, columns) / self.at.noise**2
        information = self.at.information(np.concatenate([self.at.slopes, columns], axis=2))
        return WindowScore(information, np.append(self.slope, changes))


@dataclass(frozen=True)
class SeenWindows:
    """All windows of a survey beside S sensors.

    Attributes
    ----------
    each
        One by one.
    windows
        The same as they were laid.
    prior
        Information about the sensors that is assumed, shape (16 S, 16 S).
    """

    each: tuple[SeenWindow, ...]
    windows: SuiteWindows
    prior: FloatArray

    @classmethod
    def of(
        cls, readings: Readings, sensors: FloatArray, options: SuiteCalibrationOptions
    ) -> "SeenWindows":
        """Lay windows over a survey.

        Parameters
        ----------
        readings
            At the sensors' clocks.
        sensors
            Parameters of S sensors, shape (S, 16).
        options
            Windows, and how far sensors may be from these.

        Raises
        ------
        MapError
            There are too few readings.
        """
        windows, each = windows_over(readings, sensors, NO_SOURCES, options), []
        for part, rows in zip(windows.parts, windows.rows, strict=True):
            window = replace(part, readings=readings[rows])
            at = window_slopes(window, sensors, windows.prior)
            each.append(SeenWindow(window, at, likelihood_at(window, at, sensors).slope))
        return cls(tuple(each), windows, prior_information(len(sensors), options))

    def likeness(self, residuals: Sequence[FloatArray]) -> float:
        """Return how many readings count as one, by the residuals of each window, (N, 3)."""
        return likeness(self.windows, residuals)


def scored(
    windows: Sequence[WindowScore], alike: float, prior: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return one step of scoring, shape (p,), and its standard deviations, shape (p,).

    Parameters
    ----------
    windows
        That take part.
    alike
        How many neighbouring readings err alike.
    prior
        Information about the parameters that is assumed, shape (p, p).
    """
    information = np.sum([each.information for each in windows], axis=0) / alike
    slope = np.sum([each.slope for each in windows], axis=0) / alike
    factor = cho_factor(information + prior)
    covariance = cho_solve(factor, np.eye(len(slope)))
    return cho_solve(factor, slope), np.sqrt(np.diag(covariance))
