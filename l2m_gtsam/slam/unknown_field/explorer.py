"""On-line SLAM in an unknown field, key pose by key pose.

The memory is one Gaussian over the field's weights, tile by tile, the key poses that anchor tiles,
and the last key pose. The last stretch of the path is solved again as it grows, with the memory as
its prior; at its end the memory is updated, and the stretch's other poses are marginalised. So both
cost and memory grow with the building and not with the drive.

The correlations between tiles are essential: tiles that count as independent, or as exactly known,
drift as odometry does, and the sigmas do not show it.
"""

from dataclasses import dataclass

import gtsam
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

GROUP, SECTION = 20, 100  # limits in key poses instead of metres, for a vehicle that turns


class ExploringOptions(Options):
    """How an unknown field is explored on line; lengths in metres of path."""

    group_m: float = Field(default=2.0, gt=0)
    """New key poses are solved after this distance; until then they are predicted by odometry. Half
    of it costs nearly twice the time."""
    section_m: float = Field(default=10.0, gt=0)
    """So much is solved together; of what lies further back tiles alone are kept. A vehicle that
    comes back as far off as odometry has drifted has to find its place within it."""


@dataclass(frozen=True)
class MarginalizedPose:
    """A marginalised key pose, kept relative to the anchor of its tile."""

    anchor: int
    T_anchor_key: gtsam.Pose3


class Explorer:
    """Estimates poses and field on line: its state after the key poses added so far.

    Calibrations are fixed, and scans are not used. All readings of a tile determine the sensors'
    heights together; those of marginalised poses cannot be linearised again.

    Parameters
    ----------
    drive
        K key poses with odometry and readings.
    options
        As of a localisation. Fewer `tiles.modes` take far less time.
    prior
        Of the field; if not given it is learnt over the first metres, by poses of odometry.
    pace
        How often is solved, and how much together.

    Raises
    ------
    ConfigError
        Calibrations are to be refined, or odometry knows its steps along fixed axes.
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
        if drive.steps.fixed_axes is not None:
            raise ConfigError("`slam.drift.axes: fixed` works off line; on line give `vehicle`")
        drive = drive.as_walk(options.drift.over_m)
        self._drive, self._options = drive, options
        self._pace = ExploringOptions() if pace is None else pace
        self._memory = FieldMemory.at_start(drive)
        self._path = drive.steps.path
        self._first = self._solved = 0
        self._past: list[MarginalizedPose] = []
        self._belief = self._prior()
        self._section = None if prior is None else self._opened(prior)

    @property
    def memory(self) -> FieldMemory:
        """The memory, without the last stretch."""
        return self._memory

    def step(self, number: int) -> Belief:
        """Add the next key pose, and return its posterior.

        Raises
        ------
        CalibrationError
            The system is too badly scaled to be solved.
        MapError
            There are too few readings to learn a prior of the field from.
        """
        pending = range(number, number + 1)
        if self._section is None and self._is_learnt_by(number):
            part = self._drive.until(number + 1)
            prior = drive_prior(part, part.dead_reckoning(), self._options.tiles)
            self._section, self._belief = self._opened(prior), self._prior()
            pending = range(number + 1)
        for k in pending:
            self._dead_reckon(k)
            if self._section is not None and self._is_due(k):
                with reported_ill_conditioning():
                    self._solve(self._section, k)
        return self._belief

    def poses(self) -> list[gtsam.Pose3]:
        """Return all solved key poses, past ones relative to their anchors' current estimates."""
        if self._section is None:
            return []
        now = self._section
        past = [now.pose(each.anchor).compose(each.T_anchor_key) for each in self._past]
        return [*past, *(now.pose(k) for k in range(len(past), self._solved + 1))]

    def _prior(self) -> Belief:
        start = as_pose(self._drive.start.T_map_lidar)
        return Belief(start, self._drive.sensors, self._memory.known.covariance)

    def _opened(self, prior: FieldPrior) -> OpenSection:
        return OpenSection(self._drive, prior, self._options, self._memory, 0)

    def _is_learnt_by(self, number: int) -> bool:
        """Return whether the prior can be learnt, or must be because the drive ends."""
        far = self._path[number] >= self._options.tiles.learn_over_m
        return bool(far or number == len(self._drive) - 1)

    def _is_due(self, number: int) -> bool:
        path, count = self._path[number] - self._path[self._solved], number - self._solved
        return bool(path >= self._pace.group_m or count >= GROUP or number == len(self._drive) - 1)

    def _dead_reckon(self, number: int) -> None:
        """Predict the belief by odometry."""
        if number > 0:
            drift = self._drive.steps.covariance[number - 1]
            predicted = self._belief.predicted(self._drive.step(number - 1), drift)
            self._belief = predicted.marginalize_previous()

    def _solve(self, section: OpenSection, number: int) -> None:
        """Solve the last stretch up to a key pose, and begin another if it is long."""
        self._belief, self._solved = section.extend(number), number
        path, count = self._path[number] - self._path[self._first], number - self._first
        if path >= self._pace.section_m or count >= SECTION:
            self._hand_over(section, number)

    def _hand_over(self, section: OpenSection, last: int) -> None:
        for k in range(len(self._past), last + 1):
            anchor = section.tile(k).anchor
            self._past.append(
                MarginalizedPose(anchor, section.pose(anchor).between(section.pose(k)))
            )
        self._memory, self._first = section.closed(), last
        self._section = section.next(self._memory, last)
