"""Follow a drive from its start, key pose by key pose: a Kalman filter, and iSAM2 behind it.

Within some tens of metres odometry drifts out of the optimiser's basin of convergence. Followed
from the start, each key pose is predicted from the last, which the map has corrected already; the
prediction's covariance bounds how far a reading may be off, and outliers are gated. A field that a
door adds to all sensors would otherwise be taken for a rotation.

The filter takes each key pose as it comes; iSAM2 takes them in groups, relinearises what has moved,
and hands its estimate back to the filter. Cost per key pose, and memory beside the poses, do not
grow with the drive: it is solved in sections.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial

import gtsam
import numpy as np
from scipy.linalg import block_diag

from l2m_factors import D, KeyPoseReadings, MapBatch, StepError, T, Whitening, X, key_pose_factor
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.progress import Progress
from l2m_gtsam.slam.drive import Drive, KnownSensors, StartPose, as_pose, as_transform
from l2m_gtsam.slam.joint_gaussian import of_key_pose, prior_factors
from l2m_gtsam.slam.key_pose_readings import joined_readings
from l2m_gtsam.slam.links import Links
from l2m_gtsam.slam.map_prediction import sensors_in
from l2m_gtsam.slam.marginals import reported_ill_conditioning
from l2m_gtsam.slam.online.belief import POSE, Belief, PredictedBelief
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose, key_poses_of
from l2m_gtsam.slam.online.measurements import (
    CachedVariance,
    StepMeasurement,
    StepReadings,
    fix_measurement,
    gate,
    update,
)
from l2m_gtsam.slam.online.section import Section
from l2m_gtsam.slam.online.tracked_drift import TrackedDrift
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.pose_graph import (
    between_factor,
    calibration_graph,
    calibration_values,
    link_factor,
    link_pose,
    start_factor,
)

AXES = 3
SECTION = 200  # key poses that are solved together
GROUP = 10  # key poses that are added to iSAM2 together,
EARLY = 30  # but the first ones one by one: readings are not linear in calibrations far off
AGAIN = 2  # further iterations with each group, so that the next one starts from convergence


@dataclass(frozen=True)
class AcceptedReadings:
    """Readings between two key poses that the filter was updated with.

    Attributes
    ----------
    readings
        n readings, relative to the first key pose by the filter's estimate of the step.
    whitening
        Of the n residuals together.
    step
        The filter's estimate of the step, and the residuals' derivatives by it.
    """

    readings: KeyPoseReadings
    whitening: Whitening
    step: StepError


@dataclass
class PendingKeyPoses:
    """Key poses that the filter has processed and iSAM2 has not.

    Attributes
    ----------
    graph, values
        Odometry factors and key poses.
    accepted
        Gated readings of each step.
    """

    graph: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    values: gtsam.Values = field(default_factory=gtsam.Values)
    accepted: list[AcceptedReadings] = field(default_factory=list)


@dataclass(frozen=True)
class LastBelief:
    """The number of a key pose, and what is known of it, of the sensors and of odometry's drift."""

    number: int
    belief: Belief
    drift: TrackedDrift


class Follower:
    """Localises a drive on line: its state after the key poses that were added so far.

    Parameters
    ----------
    start
        Prior of the first key pose.
    sensors
        Calibrations.
    field_map
        Map that is queried for field and variance.
    options
        Loss and confidence of the gate; calibrations are variables if they are ``refined``. Over
        ``drift.over_m`` what is left of a steady drift of odometry counts as a random walk.
    section
        Key poses that are solved together.

    Attributes
    ----------
    belief
        The posterior of the last key pose.
    """

    def __init__(
        self,
        start: StartPose,
        sensors: KnownSensors,
        field_map: QueryableMap,
        options: SlamOptions,
        section: int = SECTION,
    ) -> None:
        self._sensors, self._map, self._options = sensors, field_map, options
        self._robust, self._free = options.robust, options.calibration is CalibrationUse.REFINED
        self._variance = CachedVariance(field_map)
        numbers = range(len(sensors.names) if self._free else 0)
        self._calibrations = [key for i in numbers for key in (T(i), D(i))]
        self._length, self._first, self._last = section, 0, -1
        self._past = gtsam.Values()
        self.seen = self.used = 0  # readings so far
        self.fixes_refused = 0
        self.log_likelihood = 0.0  # of readings and scans so far, each against being an outlier
        self._section = Section(self._calibrations)
        self.belief, self._pending = self._prior(start), self._opening(start)
        self._drift = TrackedDrift.at_start(options.drift.over_m, self.belief)

    @classmethod
    def resumed(
        cls, last: "LastBelief", field_map: QueryableMap, options: SlamOptions
    ) -> "Follower":
        """Return a follower that goes on from what was known of a key pose."""
        belief, number = last.belief, last.number
        start = StartPose(as_transform(belief.pose), belief.pose_covariance)
        own = cls(start, belief.sensors, field_map, options)
        sensors = belief.sensors if own._free else None
        known = of_key_pose(number, belief.pose, sensors, belief.covariance)
        own.belief, own._pending, own._drift = belief, PendingKeyPoses(), last.drift
        own._first = own._last = number
        own._section.add(prior_factors(known), known.values, number, 0)
        return own

    def forked(self) -> "Follower":
        """Return another follower that goes on from the last key pose."""
        self.finish()
        own = Follower.resumed(self.last, self._map, self._options)
        own.seen, own.used, own.fixes_refused = self.seen, self.used, self.fixes_refused
        own.log_likelihood = self.log_likelihood
        return own

    @property
    def last(self) -> "LastBelief":
        """What is known of the last key pose, from which another follower can go on."""
        return LastBelief(self._last, self.belief, self._drift)

    def expected(self, key_pose: ArrivedKeyPose) -> ArrivedKeyPose:
        """Return the next key pose without what is known of odometry's steady drift."""
        return self._drift.without(key_pose, self.belief)

    def add(self, key_pose: ArrivedKeyPose) -> Belief:
        """Add the next key pose, and return its posterior.

        Raises
        ------
        CalibrationError
            The system is too badly scaled to be solved.
        """
        number, used = key_pose.number, self.used
        if number > 0:
            self._advance(key_pose)
        is_fixed = self._update_by_fixes(key_pose.links)
        self._pending.values.insert(X(number), self.belief.pose)
        self._last = number
        # Not before there was a reading: iSAM2 needs the filter's estimate of calibrations far off.
        if 0 < number < EARLY or (number + 1) % GROUP == 0:
            self._update_section()
        if key_pose.lost or key_pose.recorded is not None:
            self._drift = self._drift.anchored(self.belief)
        elif is_fixed or self.used > used:
            self._drift = self._drift.seen(self.belief)
        return self.belief

    def finish(self) -> Belief:
        """Solve for the key poses that the filter alone has had so far."""
        if self._pending.values.size():
            self._update_section()
        return self.belief

    def release(self) -> gtsam.Values:
        """Return the key poses of sections that are closed, and forget them."""
        past, self._past = self._past, gtsam.Values()
        return past

    def values(self) -> gtsam.Values:
        """Return the estimates of all variables, by the section that each was solved in."""
        values = gtsam.Values(self._past)
        values.insert(self._section.values())
        return values

    def _opening(self, start: StartPose) -> PendingKeyPoses:
        """Return the priors of the first key pose and the calibrations."""
        pending = PendingKeyPoses()
        pending.graph.add(start_factor(start))
        if self._free:
            pending.graph.push_back(calibration_graph(self._sensors))
        return pending

    def _prior(self, start: StartPose) -> Belief:
        known = self._sensors.covariance if self._free else ()
        covariance = block_diag(start.covariance, *known)
        return Belief(as_pose(start.T_map_lidar), self._sensors, covariance)

    def _update_by_fixes(self, links: Links) -> bool:
        """Update by the scan fixes of a key pose that pass the gate; return whether one does."""
        most, passed = self._robust.largest_of(POSE), False
        for row in np.flatnonzero(links.in_map).tolist():
            own = links.covariance[row]
            covariance = self.belief.pose_covariance + own
            off = gtsam.Pose3.Logmap(link_pose(links, row).between(self.belief.pose))
            squared = off @ np.linalg.solve(covariance, off)
            if squared > most:
                self.fixes_refused += 1
            else:
                measure = partial(fix_measurement, link_pose(links, row), own)
                self.belief, passed = self.belief.updated(measure), True
                volume = np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(own)[1]
                self.log_likelihood += 0.5 * (most - squared - volume)
                self._pending.graph.add(link_factor(links, row))
        return passed

    def _advance(self, key_pose: ArrivedKeyPose) -> None:
        """Predict a key pose from the one before, and update by the readings between them."""
        expected, before = self.expected(key_pose), key_pose.number - 1
        self._drift = self._drift.moved(key_pose, self.belief)
        # Readings are placed by odometry's own step.
        of_step = StepReadings(key_pose.readings, key_pose.step, expected.covariance)
        belief = self.belief.predicted(expected.step, expected.covariance)
        self.belief = self._update_by_readings(of_step, before, belief).marginalize_previous()
        self._pending.graph.add(between_factor(before, expected.step, expected.covariance))

    def _update_by_readings(
        self, of_step: StepReadings, before: int, belief: PredictedBelief
    ) -> PredictedBelief:
        """Return the belief updated by the readings after a key pose that pass the gate."""
        if not len(of_step):
            return belief
        measurement = StepMeasurement(of_step, self._map)
        gated = gate(measurement, self._variance, belief, self._robust)
        self.seen += len(of_step)
        self.used += len(gated.rows)
        if not len(gated.rows):
            return belief
        updated = update(measurement.of(gated.rows), gated.own, belief)
        # An outlier is as likely as a reading at the end of what passes for noise.
        noise = belief.sensors.noise[of_step.readings.sensor[gated.rows]]
        of_outliers = -np.sum(0.5 * self._robust.largest + AXES * np.log(noise))
        self.log_likelihood += updated.log_likelihood - float(of_outliers)
        step = StepError(before, updated.belief.step, updated.by_step)
        readings = of_step[gated.rows].shifted(updated.belief.step)
        self._pending.accepted.append(AcceptedReadings(readings, updated.whitening, step))
        return updated.belief

    def _update_section(self) -> None:
        """Add the pending key poses to iSAM2, and take the posterior of the last from it."""
        pending, self._pending = self._pending, PendingKeyPoses()
        for factor in self._reading_factors(pending):
            pending.graph.add(factor)
        if self._free and pending.values.exists(X(0)):
            # From the filter's estimate: linearised far off, readings would lead astray.
            pending.values.insert(calibration_values(self.belief.sensors))
        sensors, section, last = self._sensors, self._section, self._last
        with reported_ill_conditioning():
            section.add(pending.graph, pending.values, last, AGAIN)
            if self._free:
                sensors = sensors_in(section.calibration(), sensors)
            self.belief = Belief(section.pose(last), sensors, section.covariance(last))
            if last - self._first >= self._length:
                self._hand_over(last)

    def _reading_factors(self, pending: PendingKeyPoses) -> Iterator[gtsam.NonlinearFactor]:
        if not pending.accepted:
            return
        fixed = None if self._free else self._sensors.fixed()
        readings = joined_readings([each.readings for each in pending.accepted])
        batch = MapBatch(self._map, readings, fixed)
        for each in pending.accepted:
            yield key_pose_factor(batch, each.step.key_pose, each.whitening, step=each.step)

    def _hand_over(self, last: int) -> None:
        """Begin a new section at the last key pose of this one."""
        values = self._section.values()
        self._past.insert(values.extract([X(k) for k in range(self._first, last)]))
        self._section = self._section.next(last)
        self._first = last


def follow(follower: Follower, drive: Drive, progress: Progress) -> gtsam.Values:
    """Follow a drive to its end and return its values."""
    for key_pose in key_poses_of(drive):
        follower.add(key_pose)
        progress("following the drive", (key_pose.number + 1) / len(drive))
    follower.finish()
    return follower.values()
