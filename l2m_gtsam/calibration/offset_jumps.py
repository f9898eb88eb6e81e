"""Jumps of H: from one moment of a drive on, a sensor reads another field wherever it is.

A tool that is laid beside a sensor does that. Against the map it looks like steel all along the
rest of the path, and sources are found that imitate it. A jump is looked for in the same averaged
readings as these, the sensors free, and stands first if it explains more of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.averaged_rows import AveragedDrive
from l2m_gtsam.calibration.causes import sensor_offsets
from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.maps.sources.found_sources import price
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.records.error_budget import MOST_JUMPS, OffsetJump

AXES = 3
MOMENTS = 40  # at which one is tried at once
FEWEST = 5  # averages of the sensor before it, and after
ANYTHING_UT = 100.0  # standard deviation of a jump before readings


@dataclass(frozen=True)
class FoundJump:
    """A jump of one sensor.

    Attributes
    ----------
    sensor
        Its index.
    stamp_ns
        Of the first average after it.
    features
        What it does to averages per uT along the sensor's axes, map frame, shape (N, 3, 3).
    """

    sensor: int
    stamp_ns: int
    features: FloatArray


@dataclass(frozen=True)
class FoundJumps:
    """Jumps with the changes of H that explain most, and what these explain.

    Attributes
    ----------
    each
        The jumps, J of them.
    change, covariance
        Of H in uT, jump by jump, shapes (3 J,) and (3 J, 3 J).
    gain
        Twice the logarithm of the likelihood ratio, less what the parameters cost (the BIC).
    """

    each: tuple[FoundJump, ...]
    change: FloatArray
    covariance: FloatArray
    gain: float

    @property
    def field(self) -> FloatArray:
        """What they do to averages, map frame, uT, shape (N, 3)."""
        return np.concatenate([each.features for each in self.each], axis=2) @ self.change

    def records(self, readings: Readings) -> tuple[OffsetJump, ...]:
        """Return them as they are reported, in order of time."""
        sigma = np.sqrt(np.diag(self.covariance)).reshape(-1, AXES)
        start = int(readings.stamp_ns.min())
        found = [
            OffsetJump(
                sensor=readings.sensors[jump.sensor],
                stamp_ns=jump.stamp_ns,
                seconds=1e-9 * (jump.stamp_ns - start),
                change=tuple(change.tolist()),
                sigma=tuple(spread.tolist()),
            )
            for jump, change, spread in zip(
                self.each, self.change.reshape(-1, AXES), sigma, strict=True
            )
        ]
        return tuple(sorted(found, key=lambda each: each.stamp_ns))


def jumps_of(rows: MarginalRows, drive: AveragedDrive) -> FoundJumps:
    """Return the jumps that averaged readings show, one after the other, the largest first.

    Parameters
    ----------
    rows, drive
        The averaged readings, N of them, their sensors free.
    """
    present, each = np.unique(drive.view.readings.sensor).tolist(), sensor_offsets(drive)
    offsets = dict(zip(present, np.split(each, len(present), axis=2), strict=True))
    found: list[FoundJump] = []
    least, beside = price(rows, AXES + 1), rows
    while True:
        few = [(s, own) for s, own in offsets.items() if count(found, s) < MOST_JUMPS]
        tried = [_best(beside, drive, own, sensor) for sensor, own in few]
        gain, jump = max(tried, key=lambda each: each[0], default=(0.0, None))
        if jump is None or gain < least:
            break
        found.append(jump)
        beside = beside.beside(jump.features, ANYTHING_UT)
    return _estimated(rows, found)


def count(found: Sequence[FoundJump], sensor: int) -> int:
    """Return how many jumps are of a sensor."""
    return sum(each.sensor == sensor for each in found)


def _best(
    rows: MarginalRows, drive: AveragedDrive, own: FloatArray, sensor: int
) -> tuple[float, FoundJump | None]:
    """Return the jump of a sensor that explains most: at some moments, then between two."""
    stamps = np.sort(drive.view.readings.stamp_ns[drive.view.readings.sensor == sensor])
    stamps = stamps[FEWEST : -FEWEST or None]
    if not len(stamps):
        return 0.0, None
    at = np.arange(len(stamps))
    while True:
        few = at[np.unique(np.linspace(0, len(at) - 1, MOMENTS).astype(int))]
        gains, features = _gains(rows, drive, own, stamps[few])
        best = int(np.argmax(gains))
        if len(few) == len(at):
            jump = FoundJump(sensor, int(stamps[few[best]]), features[best])
            return float(gains[best]), jump
        at = np.arange(few[max(best - 1, 0)], few[min(best + 1, len(few) - 1)] + 1)


def _gains(
    rows: MarginalRows, drive: AveragedDrive, own: FloatArray, stamps: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return what jumps at M moments explain each, (M,), and what they do, (M, N, 3, 3)."""
    after = drive.view.readings.stamp_ns >= stamps[:, None]
    features = own * after[:, :, None, None]
    pulled, _ = rows.pull(rows.residual)
    gains = []
    for each in features:
        pull = np.einsum("ni,nij->j", pulled, each)
        gains.append(float(pull @ np.linalg.lstsq(rows.information(each), pull, rcond=1e-10)[0]))
    return np.array(gains), features


def _estimated(rows: MarginalRows, found: Sequence[FoundJump]) -> FoundJumps:
    """Return jumps with the changes of H that explain most together."""
    if not found:
        return FoundJumps((), np.empty(0), np.empty((0, 0)), 0.0)
    features = np.concatenate([each.features for each in found], axis=2)
    pulled, _ = rows.pull(rows.residual)
    covariance = np.asarray(np.linalg.inv(rows.information(features)))
    pull = np.einsum("ni,nij->j", pulled, features)
    change = np.asarray(covariance @ pull)
    gain = float(pull @ change) - price(rows, (AXES + 1) * len(found))
    return FoundJumps(tuple(found), change, covariance, gain)


def without_jump(readings: Readings, jump: OffsetJump) -> Readings:
    """Return readings of its sensor as if H had not jumped; how much it did becomes a number's."""
    after = (readings.stamp_ns >= jump.stamp_ns).astype(float)
    numbers = np.empty((len(readings), 0)) if readings.regressors is None else readings.regressors
    return replace(
        readings,
        field=readings.field - after[:, None] * np.array(jump.change),
        regressors=np.column_stack([numbers, after]),
    )
