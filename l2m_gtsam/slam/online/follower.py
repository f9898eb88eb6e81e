"""Follow a drive from its start, key pose by key pose.

Odometry drifts out of the reach of a descent within some tens of metres; followed from where the
drive begins, each key pose is found from the last, which the map has corrected already. There it
is known how far a reading may be off, and one that is further counts for nothing: a field that a
door adds to all sensors would otherwise be taken for a turn.

A Kalman filter takes each key pose as it comes; iSAM2 takes them by the dozen, linearises anew what
has moved, and tells the filter what it found. What a key pose costs, and the memory that is needed
beside the poses, does not grow with the drive: it is solved section by section.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial

import gtsam
import numpy as np
from scipy.linalg import block_diag

from l2m_factors import (
    D,
    MapBatch,
    StepError,
    T,
    Whitening,
    X,
    key_pose_factor,
)
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import IntArray
from l2m_gtsam.progress import Progress
from l2m_gtsam.slam.drive import Drive, as_pose
from l2m_gtsam.slam.map_prediction import sensors_in
from l2m_gtsam.slam.online.belief import POSE, Belief, PredictedBelief
from l2m_gtsam.slam.online.measurements import (
    CachedVariance,
    StepMeasurement,
    StepReadings,
    fix_measurement,
    gate,
    update,
)
from l2m_gtsam.slam.online.section import Section
from l2m_gtsam.slam.pose_graph import (
    calibration_graph,
    calibration_values,
    link_factor,
    link_pose,
    start_factor,
    step_factor,
)
from l2m_gtsam.slam.relative_motion import interpolated_readings
from l2m_gtsam.slam.solver import reported_ill_conditioning
from l2m_gtsam.solve.robust import RobustOptions

SECTION = 200  # key poses that are solved together
GROUP = 10  # key poses that come to iSAM2 together,
EARLY = 30  # and the first so many one by one: in calibrations far off, readings are not linear
AGAIN = 2  # more steps with each group, so that the next one starts from where this one converged


@dataclass(frozen=True)
class AcceptedReadings:
    """Readings between two key poses that the filter took.

    Attributes
    ----------
    rows
        Which, shape (n,).
    whitening
        Of their residuals.
    step
        As the filter has it, and what they feel of its error.
    """

    rows: IntArray
    whitening: Whitening
    step: StepError


@dataclass
class PendingKeyPoses:
    """Key poses that the filter has taken and iSAM2 has not.

    Attributes
    ----------
    graph, values
        Odometry and key poses.
    legs
        Readings between them that passed.
    """

    graph: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    values: gtsam.Values = field(default_factory=gtsam.Values)
    accepted: list[AcceptedReadings] = field(default_factory=list)


class Follower:
    """A drive as far as it was followed.

    Parameters
    ----------
    drive
        The drive.
    field_map
        The map.
    robust
        Which readings pass where a pose is predicted.
    free
        Whether calibrations are variables.
    section
        Key poses that are solved together.
    """

    def __init__(
        self,
        drive: Drive,
        field_map: QueryableMap,
        robust: RobustOptions,
        *,
        free: bool,
        section: int = SECTION,
    ) -> None:
        self._drive, self._map, self._robust, self._free = drive, field_map, robust, free
        self._variance = CachedVariance(field_map)
        self._ends = np.searchsorted(drive.readings.key_pose, np.arange(len(drive) + 1))
        fixes = np.flatnonzero(drive.links.in_map)
        self._fixes = fixes[np.argsort(drive.links.key_pose[fixes], kind="stable")]
        self._fix_ends = np.searchsorted(
            drive.links.key_pose[self._fixes], np.arange(len(drive) + 1)
        )
        sensors = range(len(drive.sensors.names) if free else 0)
        self._calibrations = [key for i in sensors for key in (T(i), D(i))]
        self._length, self._first, self._past = section, 0, gtsam.Values()
        self._section = Section(self._calibrations)
        self._belief, self._pending = self._at_start(), self._opening()

    def step(self, number: int) -> Belief:
        """Add a key pose, and return what is known of it then; they come in order.

        Raises
        ------
        CalibrationError
            What is known of poses and sensors is too many orders of magnitude apart.
        """
        if number > 0:
            self._advance(number)
        self._fix(number)
        self._pending.values.insert(X(number), self._belief.pose)
        last = len(self._drive) - 1
        # Not before there was a reading: calibrations far off have to come from the filter.
        if 0 < number < EARLY or (number + 1) % GROUP == 0 or number == last:
            with reported_ill_conditioning():
                self._update_section(number)
        return self._belief

    def values(self) -> gtsam.Values:
        """Return all variables, as their sections have them."""
        values = gtsam.Values(self._past)
        values.insert(self._section.values())
        return values

    def _opening(self) -> PendingKeyPoses:
        """Return what is known before the first key pose."""
        pending = PendingKeyPoses()
        pending.graph.add(start_factor(self._drive.start))
        if self._free:
            pending.graph.push_back(calibration_graph(self._drive.sensors))
        return pending

    def _at_start(self) -> Belief:
        start, sensors = self._drive.start, self._drive.sensors
        known = sensors.covariance if self._free else ()
        covariance = block_diag(start.covariance, *known)
        return Belief(as_pose(start.T_map_lidar), sensors, covariance)

    def _fix(self, number: int) -> None:
        """Take what scans say of a key pose's place in the map, as far as it passes for such."""
        links, most = self._drive.links, self._robust.largest_of(POSE)
        for row in self._fixes[self._fix_ends[number] : self._fix_ends[number + 1]].tolist():
            covariance = self._belief.pose_covariance + links.covariance[row]
            off = gtsam.Pose3.Logmap(link_pose(links, row).between(self._belief.pose))
            if off @ np.linalg.solve(covariance, off) <= most:
                seen = partial(fix_measurement, link_pose(links, row), links.covariance[row])
                self._belief = self._belief.updated(seen)
                self._pending.graph.add(link_factor(links, row))

    def _advance(self, number: int) -> None:
        """Go on to a key pose from the one before, and take what was read on the way."""
        before, steps = number - 1, self._drive.steps
        belief = self._belief.predicted(self._drive.step(before), steps.covariance[before])
        self._belief = self._read(before, belief).marginalize_previous()
        self._pending.graph.add(step_factor(self._drive, before))

    def _read(self, number: int, belief: PredictedBelief) -> PredictedBelief:
        """Take the readings after a key pose as far as they pass for such."""
        rows = np.arange(self._ends[number], self._ends[number + 1])
        if not len(rows):
            return belief
        view = StepMeasurement(StepReadings.of(self._drive, rows, number), self._map)
        gated = gate(view, self._variance, belief, self._robust)
        if not len(gated.rows):
            return belief
        updated = update(view.of(gated.rows), gated.own, belief)
        step = StepError(number, updated.belief.step, updated.by_step)
        self._pending.accepted.append(AcceptedReadings(rows[gated.rows], updated.whitening, step))
        return updated.belief

    def _update_section(self, number: int) -> None:
        """Give iSAM2 the key poses that wait, and take from it what is known of the last."""
        pending, self._pending = self._pending, PendingKeyPoses()
        for factor in self._reading_factors(pending):
            pending.graph.add(factor)
        if self._free and pending.values.exists(X(0)):
            # From the filter's estimate: linearised at values far off, readings would lead astray.
            pending.values.insert(calibration_values(self._belief.sensors))
        self._section.add(pending.graph, pending.values, number, AGAIN)
        sensors, section = self._drive.sensors, self._section
        if self._free:
            sensors = sensors_in(section.calibration(), sensors)
        self._belief = Belief(section.pose(number), sensors, section.covariance(number))
        if number - self._first >= self._length:
            self._hand_over(number)

    def _reading_factors(self, pending: PendingKeyPoses) -> Iterator[gtsam.NonlinearFactor]:
        if not pending.accepted:
            return
        rows = np.concatenate([readings_of_step.rows for readings_of_step in pending.accepted])
        steps = [
            readings_of_step.step.step
            for readings_of_step in pending.accepted
            for _ in readings_of_step.rows
        ]
        readings = interpolated_readings(self._drive, rows, steps)
        fixed = None if self._free else self._drive.sensors.fixed()
        batch = MapBatch(self._map, readings, fixed)
        for readings_of_step in pending.accepted:
            yield key_pose_factor(
                batch,
                readings_of_step.step.key_pose,
                readings_of_step.whitening,
                step=readings_of_step.step,
            )

    def _hand_over(self, last: int) -> None:
        """Begin a section with the last key pose of this one."""
        values = self._section.values()
        self._past.insert(values.extract([X(k) for k in range(self._first, last)]))
        self._section = self._section.next(last)
        self._first = last


def follow(follower: Follower, count: int, progress: Progress) -> gtsam.Values:
    """Follow a drive of so many key poses to its end and return its values."""
    for number in range(count):
        follower.step(number)
        progress("following the drive", (number + 1) / count)
    return follower.values()
