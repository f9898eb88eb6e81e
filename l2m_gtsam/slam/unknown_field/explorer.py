"""Poses and field of a drive through an unknown place, key pose by key pose.

What is remembered is one Gaussian: of the field's weights, tile by tile, of the key poses that
tiles are fixed to, and of the last one. The last stretch of the way is solved again as it grows,
with what is remembered as its prior; at its end what was learnt goes over to all of the memory, and
its other poses are let go. So both cost and memory grow with the building and not with the drive.

That the errors of tiles hang together is what matters: tiles that are taken for independent, or
for known, drift as odometry does, and sigmas do not tell.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from pydantic import Field

from l2m_gtsam.errors import ConfigError
from l2m_gtsam.options import Options
from l2m_gtsam.slam.drive import Drive, as_pose
from l2m_gtsam.slam.online.belief import Belief
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.solver import reported_ill_conditioning
from l2m_gtsam.slam.unknown_field.field_memory import FieldMemory
from l2m_gtsam.slam.unknown_field.open_section import OpenSection
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior, drive_prior

GROUP, SECTION = 20, 100  # key poses that are as good as these ways, for a vehicle that turns


class ExploringOptions(Options):
    """How an unknown field is followed on line; lengths in metres of way."""

    group_m: float = Field(default=2.0, gt=0)
    """After so much way what has come is solved; until then poses are carried on by odometry. Half
    of it costs nearly twice the time."""
    section_m: float = Field(default=10.0, gt=0)
    """So much is solved together; of what lies further back tiles alone are kept. A vehicle that
    comes back as far off as odometry has drifted has to find its place within it."""


@dataclass(frozen=True)
class MarginalizedPose:
    """A key pose that is no variable any more: where it was in the frame of its tile's anchor."""

    anchor: int
    T_anchor_key: gtsam.Pose3


class Explorer:
    """A drive as far as it was followed through a place without a map.

    Calibrations are as they are given, and scans do not take part. How high sensors sit is told by
    what all readings of a tile determine together: those that were let go cannot be asked again.

    Parameters
    ----------
    drive
        The drive.
    options
        How to solve. Fewer `tiles.modes` take far less time.
    prior
        Of the field; without it, it is learnt as the options say over the first metres, during
        which poses are those of odometry.
    pace
        How often, and how much together.

    Raises
    ------
    ConfigError
        Calibrations are to be refined.
    """

    def __init__(
        self,
        drive: Drive,
        options: SlamOptions,
        prior: FieldPrior | None = None,
        pace: ExploringOptions | None = None,
    ) -> None:
        if options.calibration is CalibrationUse.REFINED:
            raise ConfigError(
                "`slam.calibration: refined` works off line where there is no map; on line give "
                "`fixed`"
            )
        drive = drive.with_scale_as_drift(options.drift.over_m)
        self._drive, self._options = drive, options
        self._pace = ExploringOptions() if pace is None else pace
        self._memory = FieldMemory.at_start(drive)
        self._way = np.append(0.0, np.cumsum(np.linalg.norm(drive.steps.p, axis=1)))
        self._first = self._solved = 0
        self._past: list[MarginalizedPose] = []
        self._belief = self._at_start()
        self._section = None if prior is None else self._opened(prior)

    @property
    def memory(self) -> FieldMemory:
        """What is remembered of all but the last stretch."""
        return self._memory

    def step(self, number: int) -> Belief:
        """Add a key pose, and return what is known of it then; they come in order.

        Raises
        ------
        CalibrationError
            What is known is too many orders of magnitude apart.
        MapError
            There are too few readings to learn a prior of the field from.
        """
        pending = range(number, number + 1)
        if self._section is None and self._is_learnt_by(number):
            part = self._drive.until(number + 1)
            prior = drive_prior(part, part.dead_reckoning(), self._options.tiles)
            self._section, self._belief = self._opened(prior), self._at_start()
            pending = range(number + 1)
        for k in pending:
            self._carry(k)
            if self._section is not None and self._is_due(k):
                with reported_ill_conditioning():
                    self._settle(self._section, k)
        return self._belief

    def poses(self) -> list[gtsam.Pose3]:
        """Return all key poses that were solved, where the anchors of their tiles are by now."""
        if self._section is None:
            return []
        now = self._section
        past = [now.pose(each.anchor).compose(each.T_anchor_key) for each in self._past]
        return [*past, *(now.pose(k) for k in range(len(past), self._solved + 1))]

    def _at_start(self) -> Belief:
        start = as_pose(self._drive.start.T_map_lidar)
        return Belief(start, self._drive.sensors, self._memory.known.covariance)

    def _opened(self, prior: FieldPrior) -> OpenSection:
        return OpenSection(self._drive, prior, self._options, self._memory, 0)

    def _is_learnt_by(self, number: int) -> bool:
        """Return whether the prior can be learnt, or has to be, for nothing more will come."""
        far = self._way[number] >= self._options.tiles.learn_over_m
        return bool(far or number == len(self._drive) - 1)

    def _is_due(self, number: int) -> bool:
        way, count = self._way[number] - self._way[self._solved], number - self._solved
        return bool(way >= self._pace.group_m or count >= GROUP or number == len(self._drive) - 1)

    def _carry(self, number: int) -> None:
        """Carry on by odometry what is known."""
        if number > 0:
            drift = self._drive.steps.covariance[number - 1]
            predicted = self._belief.predicted(self._drive.step(number - 1), drift)
            self._belief = predicted.marginalize_previous()

    def _settle(self, section: OpenSection, number: int) -> None:
        """Solve the last stretch up to a key pose, and begin another one if it is long."""
        self._belief, self._solved = section.extend(number), number
        way, count = self._way[number] - self._way[self._first], number - self._first
        if way >= self._pace.section_m or count >= SECTION:
            self._hand_over(section, number)

    def _hand_over(self, section: OpenSection, last: int) -> None:
        for k in range(len(self._past), last + 1):
            anchor = section.tile(k).anchor
            self._past.append(
                MarginalizedPose(anchor, section.pose(anchor).between(section.pose(k)))
            )
        self._memory, self._first = section.closed(), last
        self._section = section.next(self._memory, last)
