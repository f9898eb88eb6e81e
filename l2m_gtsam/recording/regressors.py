"""Recorded numbers, interpolated at the times of the readings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from l2m_gtsam.data import BoolArray, FloatArray, IntArray, Readings, ScalarSeries, Synchronised
from l2m_gtsam.errors import SyncError
from l2m_gtsam.options import Options
from l2m_gtsam.recording.sync import lies_between

STILL = 1e-9  # of its size: a number that varies less follows from rounding


class ResampleOptions(Options):
    """How numbers get from their own times to those of the readings."""

    max_gap_s: float = Field(default=0.5, gt=0)
    """Between two samples further apart than this a number is not known; it is never
    extrapolated."""


@dataclass(frozen=True)
class Resampled:
    """Numbers at the times of readings.

    Attributes
    ----------
    values
        K numbers in the units of their series, shape (N, K); 0 where one is not known.
    known
        Whether all of them are known at a reading, shape (N,).
    """

    values: FloatArray
    known: BoolArray


def resampled(
    series: Sequence[ScalarSeries], stamp_ns: IntArray, options: ResampleOptions
) -> Resampled:
    """Interpolate numbers along the line between two samples.

    Parameters
    ----------
    series
        K series.
    stamp_ns
        Times of the readings in nanoseconds, in any order, shape (N,).
    options
        How far apart samples may be.
    """
    values = np.zeros((len(stamp_ns), len(series)))
    known = np.ones(len(stamp_ns), dtype=np.bool_)
    for k, each in enumerate(series):
        near = lies_between(each.stamp_ns, stamp_ns, options.max_gap_s)
        known &= near
        if near.any():
            # Seconds since 1970 in double precision would keep tenths of a microsecond only.
            at_s, sample_s = (1e-9 * (ns - each.stamp_ns[0]) for ns in (stamp_ns, each.stamp_ns))
            values[near, k] = np.interp(at_s[near], sample_s, each.value)
    return Resampled(values, known)


def with_regressors(
    synchronised: Synchronised, series: Sequence[ScalarSeries], options: ResampleOptions
) -> Synchronised:
    """Return the readings at which all numbers are known, with them; all readings for no numbers.

    Parameters
    ----------
    synchronised
        Readings and their account.
    series
        K series.
    options
        How far apart samples may be.

    Raises
    ------
    SyncError
        No reading is left.
    """
    if not series:
        return synchronised
    readings = synchronised.readings
    found = resampled(series, readings.stamp_ns, options)
    if not found.known.any():
        raise SyncError(_none_known(readings.stamp_ns, series, options))
    dropped = np.bincount(readings.sensor[~found.known], minlength=len(readings.sensors))
    counts = tuple(
        replace(count, kept=count.kept - int(without), without_regressor=int(without))
        for count, without in zip(synchronised.counts, dropped, strict=True)
    )
    readings = replace(readings, regressors=found.values)
    return Synchronised(readings.select(found.known), counts)


def check_changes(readings: Readings, series: Sequence[ScalarSeries]) -> None:
    """Raise a SyncError for a number that is the same at all readings."""
    if readings.regressors is None:
        return
    for each, values in zip(series, readings.regressors.T, strict=True):
        if np.ptp(values) <= STILL * np.abs(values).max():
            raise SyncError(
                f"regressor {each.name!r}: it is {values[0]:g} at all readings, which cannot "
                "be separated from the offset H; leave it out of `bag.regressors`"
            )


def _none_known(
    stamp_ns: IntArray, series: Sequence[ScalarSeries], options: ResampleOptions
) -> str:
    spans = ", ".join(
        f"{each.name!r} from {each.stamp_ns[0] * 1e-9:.3f} to {each.stamp_ns[-1] * 1e-9:.3f} s"
        for each in series
        if len(each)
    )
    first, last = stamp_ns.min() * 1e-9, stamp_ns.max() * 1e-9
    return (
        f"no reading has all recorded numbers: readings run from {first:.3f} to {last:.3f} s, "
        f"{spans}, and samples may be "
        f"{options.max_gap_s:g} s apart at most (`calibration.regressors.max_gap_s`); if clocks "
        "differ, try `bag.stamps: record`"
    )
