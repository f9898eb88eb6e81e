"""H that changes during a drive: it jumps at one moment, or drifts all the time.

A tool that is laid beside a sensor makes it jump; a sensor that warms up makes it drift, ever more
slowly. Against the map a jump looks like steel all along the rest of the path, and sources are
found that imitate it; a drift looks like changes of C. Both are looked for in the same averaged
readings as steel, the sensors free, and stand first if they explain more of them.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from l2m_gtsam.calibration.averaged_rows import AveragedDrive
from l2m_gtsam.calibration.drive_sources import gains, sensor_offsets
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.maps.sources.found_sources import price
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.records.error_budget import MOST_JUMPS, OffsetDrift, OffsetJump, drift_share

AXES = 3
MOMENTS = 40  # at which a jump is tried at once
FEWEST = 20  # averages of the sensor before it, and after: what is shorter is a stretch
SLOWING = (0.5, 0.25, 0.12, 0.06)  # time constants of drifts, in the length of the drive
ANYTHING_UT = 100.0  # standard deviation of a jump or a drift before readings
Course = OffsetJump | OffsetDrift


@dataclass(frozen=True)
class FoundCourse:
    """A jump or a drift of H of one sensor.

    Attributes
    ----------
    sensor
        Its index.
    stamp_ns
        Of the first average after a jump; a drift has none.
    time_constant_s
        Of a drift that slows down.
    features
        What it does to averages per uT along the sensor's axes, map frame, shape (N, 3, 3).
    """

    sensor: int
    stamp_ns: int | None
    time_constant_s: float | None
    features: FloatArray

    @property
    def parameters(self) -> int:
        """How many numbers describe it: the moment of a jump, or the time constant, is one."""
        return AXES + (self.stamp_ns is not None or self.time_constant_s is not None)

    def record(self, readings: Readings, change: FloatArray, sigma: FloatArray) -> Course:
        """Return it as it is reported, changes and standard deviations in uT, shapes (3,)."""
        name, start = readings.sensors[self.sensor], int(readings.stamp_ns.min())
        own = tuple(change.tolist()), tuple(sigma.tolist())
        if self.stamp_ns is None:
            whole_s = 1e-9 * int(np.ptp(readings.stamp_ns))
            return OffsetDrift(name, start, whole_s, *own, self.time_constant_s)
        return OffsetJump(name, self.stamp_ns, 1e-9 * (self.stamp_ns - start), *own)


@dataclass(frozen=True)
class FoundCourses:
    """Jumps and drifts with the changes of H that explain most, and what these explain.

    Attributes
    ----------
    each
        J of them.
    change, covariance
        Of H in uT, one after the other, shapes (3 J,) and (3 J, 3 J).
    gain
        Twice the logarithm of the likelihood ratio, less what the parameters cost (the BIC).
    """

    each: tuple[FoundCourse, ...]
    change: FloatArray
    covariance: FloatArray
    gain: float

    @property
    def parameters(self) -> int:
        """How many numbers describe all of them."""
        return sum(each.parameters for each in self.each)

    @property
    def field(self) -> FloatArray:
        """What they do to averages, map frame, uT, shape (N, 3)."""
        return np.concatenate([each.features for each in self.each], axis=2) @ self.change

    def records(self, readings: Readings) -> tuple[Course, ...]:
        """Return them as they are reported, in order of time."""
        sigma = np.sqrt(np.diag(self.covariance)).reshape(-1, AXES)
        each = zip(self.each, self.change.reshape(-1, AXES), sigma, strict=True)
        found = [course.record(readings, change, spread) for course, change, spread in each]
        return tuple(sorted(found, key=lambda each: each.stamp_ns))


def courses_of(rows: MarginalRows, drive: AveragedDrive) -> FoundCourses:
    """Return the jumps and drifts that averaged readings show, the plainest first.

    Parameters
    ----------
    rows, drive
        The averaged readings, N of them, their sensors free.
    """
    present, each = np.unique(drive.view.readings.sensor).tolist(), sensor_offsets(drive)
    offsets = dict(zip(present, np.split(each, len(present), axis=2), strict=True))
    found, search = list[FoundCourse](), CourseSearch(rows, drive.view.readings, offsets)
    while True:
        net, best = max(search.each(found), key=lambda each: each[0], default=(-np.inf, None))
        if best is None or net < 0:
            break
        found.append(best)
        search = replace(search, rows=search.rows.beside(best.features, ANYTHING_UT))
    return _needed(rows, _estimated(rows, found))


def _needed(rows: MarginalRows, found: FoundCourses) -> FoundCourses:
    """Return those without which less is explained: several jumps may make a drift needless."""
    fewer = (
        _estimated(rows, [each for each in found.each if each is not one]) for one in found.each
    )
    best = max(fewer, key=lambda each: each.gain, default=found)
    return _needed(rows, best) if best.gain > found.gain else found


@dataclass(frozen=True)
class CourseSearch:
    """Where a jump or a drift is looked for.

    Attributes
    ----------
    rows, readings
        The averaged readings, N of them, beside what was found before.
    offsets
        By sensor what H does to averages per uT along its axes, map frame, shape (N, 3, 3).
    """

    rows: MarginalRows
    readings: Readings
    offsets: Mapping[int, FloatArray]

    def each(self, found: Sequence[FoundCourse]) -> Iterator[tuple[float, FoundCourse]]:
        """Yield the best jump and the drift of each sensor, and first what each explains net.

        A sensor drifts once, and jumps a few times, beside what was ``found`` of it.
        """
        for sensor in self.offsets:
            before = [each.stamp_ns for each in found if each.sensor == sensor]
            jumps = [stamp for stamp in before if stamp is not None]
            tried = [self.jump(sensor, jumps)] if len(jumps) < MOST_JUMPS else []
            if len(jumps) == len(before):
                tried += self.drifts(sensor)
            for gain, course in tried:
                if course is not None:
                    yield gain - price(self.rows, course.parameters), course

    def jump(self, sensor: int, before: Sequence[int]) -> tuple[float, FoundCourse | None]:
        """Return the jump of a sensor that explains most: at some moments, then between two.

        ``before`` are the stamps of jumps that it has already.
        """
        own, stamp_ns = self.offsets[sensor], self.readings.stamp_ns
        stamps = np.sort(stamp_ns[self.readings.sensor == sensor])
        ends = np.array([0, len(stamps), *np.searchsorted(stamps, before)])
        apart = np.abs(np.arange(len(stamps))[:, None] - ends).min(axis=1)
        stamps = stamps[apart >= FEWEST]
        if not len(stamps):
            return 0.0, None
        at = np.arange(len(stamps))
        while True:
            few = at[np.unique(np.linspace(0, len(at) - 1, MOMENTS).astype(int))]
            after = stamp_ns[:, None] >= stamps[few]
            features = own[:, :, None, :] * after[:, None, :, None]
            gain = self._gains(features.reshape(len(own), AXES, -1))
            best = int(np.argmax(gain))
            if len(few) == len(at):
                jump = FoundCourse(sensor, int(stamps[few[best]]), None, features[:, :, best])
                return float(gain[best]), jump
            at = np.arange(few[max(best - 1, 0)], few[min(best + 1, len(few) - 1)] + 1)

    def drifts(self, sensor: int) -> list[tuple[float, FoundCourse | None]]:
        """Return drifts of a sensor: steady, and slowing down."""
        stamp_ns = self.readings.stamp_ns
        seconds = 1e-9 * (stamp_ns - stamp_ns.min())
        if not seconds.any():
            return []
        whole = float(seconds.max())
        constants = [None, *(share * whole for share in SLOWING)]
        shares = np.stack([drift_share(seconds, whole, each) for each in constants], axis=1)
        features = self.offsets[sensor][:, :, None, :] * shares[:, None, :, None]
        gain = self._gains(features.reshape(len(features), AXES, -1)).tolist()
        return [
            (gain[k], FoundCourse(sensor, None, each, features[:, :, k]))
            for k, each in enumerate(constants)
        ]

    def _gains(self, features: FloatArray) -> FloatArray:
        """Return what courses explain each, if H may follow them by anything."""
        return gains(self.rows, features, self._pulled, AXES)

    @cached_property
    def _pulled(self) -> FloatArray:
        return self.rows.pull(self.rows.residual)[0]


def _estimated(rows: MarginalRows, found: Sequence[FoundCourse]) -> FoundCourses:
    """Return jumps and drifts with the changes of H that explain most together."""
    if not found:
        return FoundCourses((), np.empty(0), np.empty((0, 0)), 0.0)
    features = np.concatenate([each.features for each in found], axis=2)
    pulled, _ = rows.pull(rows.residual)
    covariance = np.asarray(np.linalg.inv(rows.information(features)))
    pull = np.einsum("ni,nij->j", pulled, features)
    change = np.asarray(covariance @ pull)
    gain = float(pull @ change) - price(rows, sum(each.parameters for each in found))
    return FoundCourses(tuple(found), change, covariance, gain)


def without_course(readings: Readings, course: Course) -> Readings:
    """Return readings of its sensor as if H had not changed; how much it did becomes a number's."""
    stamp_ns = readings.stamp_ns
    if isinstance(course, OffsetJump):
        number = (stamp_ns >= course.stamp_ns).astype(float)
    else:
        number = course.share(stamp_ns)
    numbers = np.empty((len(readings), 0)) if readings.regressors is None else readings.regressors
    return replace(
        readings,
        field=readings.field - number[:, None] * np.array(course.change),
        regressors=np.column_stack([numbers, number]),
    )
