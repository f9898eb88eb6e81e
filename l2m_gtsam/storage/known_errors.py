"""How well a sensor in a file is known: its covariance, or sigmas in its place."""

from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from l2m_gtsam.data import FloatArray

SIZE, TAU = 16, 15  # (t, C row by row, H, time offset); the last is the offset
SHAPES = {"t_sigma": (3,), "C_sigma": (3, 3), "H_sigma": (3,)}
ROUNDING = 1e-6  # of a variance, of numbers written with few digits
# What a calibration leaves open is anywhere within these sigmas: metres, 1, uT, seconds.
OPEN = np.repeat([1.0, 1.0, 100.0, 0.1], [3, 9, 3, 1])


class StatedClock(BaseModel):
    """How well a time offset is known."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    sigma: Any = None
    cross_covariance: Any = None


class StatedErrors(BaseModel):
    """What a file says of a sensor's errors; all of it may be absent."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    covariance: Any = None
    common: Any = None
    t_sigma: Any = None
    C_sigma: Any = None
    H_sigma: Any = None
    time_offset: StatedClock | None = None

    def known(self) -> FloatArray | None:
        """Return the covariance of (t, C row by row, H, time offset), (16, 16); none if not said.

        Raises
        ------
        ValueError
            A sigma is not positive, or the covariance is none.
        """
        clock = StatedClock() if self.time_offset is None else self.time_offset
        if self.covariance is None:
            own = _of_sigmas(self, clock)
        else:
            own = np.zeros((SIZE, SIZE))
            own[:TAU, :TAU] = _numbers("covariance", self.covariance, (TAU, TAU))
            own[TAU, TAU] = _variance_of(clock)
            if clock.cross_covariance is not None and own[TAU, TAU] > 0:
                cross = _numbers("time_offset.cross_covariance", clock.cross_covariance, (TAU,))
                own[:TAU, TAU] = own[TAU, :TAU] = cross
        return None if own is None else _proper(own)

    def in_common(self) -> FloatArray | None:
        """Return the root of what is common with the file's other sensors, (16, r); none if not.

        Raises
        ------
        ValueError
            It is no part of the covariance.
        """
        if self.common is None:
            return None
        root, own = _numbers("common", self.common, None), self.known()
        if root.ndim != 2 or len(root) != SIZE or not np.isfinite(root).all():
            raise ValueError(f"common has shape {root.shape}; {SIZE} rows of numbers are needed")
        if own is None:
            raise ValueError("common is part of a covariance, which is missing")
        sigma = np.sqrt(np.diag(own))
        scale = np.where(sigma > 0, sigma, 1.0)
        if np.linalg.eigvalsh((own - root @ root.T) / np.outer(scale, scale)).min() < -ROUNDING:
            raise ValueError("common is larger than the covariance that it is part of")
        return root


def _of_sigmas(stated: StatedErrors, clock: StatedClock) -> FloatArray | None:
    """Return a diagonal covariance; what no sigma is given for counts as exact."""
    given = [getattr(stated, name) for name in SHAPES]
    if all(each is None for each in given) and clock.sigma is None:
        return None
    sigmas = [
        np.zeros(shape) if each is None else _sigma(name, each, shape)
        for (name, shape), each in zip(SHAPES.items(), given, strict=True)
    ]
    variances = [np.square(each).ravel() for each in sigmas]
    return np.diag(np.append(np.concatenate(variances), _variance_of(clock)))


def _variance_of(clock: StatedClock) -> float:
    """Return that of a time offset; one that was held, or has no sigma, counts as exact."""
    if clock.sigma is None:
        return 0.0
    sigma = float(_numbers("time_offset.sigma", clock.sigma, ()))
    if not sigma >= 0:
        raise ValueError(f"time_offset.sigma is {sigma:g}; a sigma is positive")
    return sigma**2 if np.isfinite(sigma) else 0.0


def _sigma(name: str, value: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return positive sigmas; one number stands for all of them."""
    try:
        sigmas = np.broadcast_to(_numbers(name, value, None), shape)
    except ValueError as error:
        shapes = " by ".join(str(length) for length in shape)
        raise ValueError(f"{name} is one number or {shapes} of them") from error
    if not (np.isfinite(sigmas) & (sigmas > 0)).all():
        raise ValueError(f"{name} is {value}; give positive numbers, or leave it out for exact")
    return sigmas


def _numbers(name: str, value: Any, shape: tuple[int, ...] | None) -> FloatArray:
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is made of numbers") from None
    if shape is not None and numbers.shape != shape:
        raise ValueError(f"{name} has shape {numbers.shape}; {shape} is needed")
    return numbers


def _proper(covariance: FloatArray) -> FloatArray:
    """Return a covariance without infinities, after checks."""
    variance = np.diag(covariance)
    if np.isnan(covariance).any() or (variance < 0).any():
        raise ValueError("covariance has entries that are no numbers, or negative variances")
    left_open = np.isinf(variance)
    covariance = np.where(left_open | left_open[:, None], 0.0, covariance)
    covariance[left_open, left_open] = OPEN[left_open] ** 2
    sigma = np.sqrt(np.diag(covariance))
    scaled = covariance / np.outer(*(np.where(sigma > 0, sigma, 1.0),) * 2)
    if not np.isfinite(scaled).all() or np.abs(scaled - scaled.T).max() > ROUNDING:
        raise ValueError("covariance is not symmetric")
    if np.linalg.eigvalsh(scaled).min() < -ROUNDING:
        raise ValueError("covariance has a negative direction; give sigmas in its place")
    return np.asarray(0.5 * (covariance + covariance.T))
