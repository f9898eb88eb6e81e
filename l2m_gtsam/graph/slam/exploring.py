"""Poses and field of a drive through an unknown place, key pose by key pose.

What is remembered is one Gaussian: of the field's weights, tile by tile, of the key poses that
tiles are fixed to, of the last one, and of calibrations that are variables. It grows with the
building and not with the drive.
"""

import gtsam
import numpy as np
from scipy.linalg import block_diag

from l2m_factors import D, T, X
from l2m_gtsam.graph.slam.belief import Belief
from l2m_gtsam.graph.slam.drive import Drive, as_pose
from l2m_gtsam.graph.slam.factors import calibration_values
from l2m_gtsam.graph.slam.field_prior import FieldPrior
from l2m_gtsam.graph.slam.joint_gaussian import JointGaussian, part_of
from l2m_gtsam.graph.slam.open_section import ExploredTile, OpenSection
from l2m_gtsam.graph.slam.options import CalibrationUse, SlamOptions

GROUP_M = 2.0  # of way after which what has come is solved
SECTION_M = 10.0  # of way that is solved together


class Explorer:
    """A drive as far as it was followed through a place without a map.

    Parameters
    ----------
    drive
        The drive.
    prior
        Of its field.
    options
        How to solve.
    section_m
        Way that is solved together, metres.
    """

    def __init__(
        self, drive: Drive, prior: FieldPrior, options: SlamOptions, section_m: float = SECTION_M
    ) -> None:
        self._drive, self._prior, self._options = drive, prior, options
        self._way = np.append(0.0, np.cumsum(np.linalg.norm(drive.steps.p, axis=1)))
        self._section_m, self._solved_m, self._opened_m = section_m, -GROUP_M, 0.0
        self.known = self._at_start()
        sensors = drive.sensors
        self._belief = Belief(
            as_pose(drive.start.T_map_lidar), sensors, np.roll(self.known.covariance, 0)
        )
        self._section = self._opened((), 0)
        self._past: dict[int, gtsam.Pose3] = {}
        self._first = 0

    def step(self, number: int) -> Belief:
        """Add a key pose, and return what is known of it then; they come in order."""
        if number > 0:
            drift = self._drive.steps.covariance[number - 1]
            self._belief = self._belief.after(self._drive.step(number - 1), drift)
        way = self._way[number]
        if way - self._solved_m >= GROUP_M or number == len(self._drive) - 1:
            self._belief = self._section.extend(number)
            self._solved_m = way
            if way - self._opened_m >= self._section_m:
                self._hand_over(number)
        return self._belief

    def poses(self) -> list[gtsam.Pose3]:
        """Return all key poses up to the last one that was solved, as their sections have them."""
        return []

    def _at_start(self) -> JointGaussian:
        start, sensors = self._drive.start, self._drive.sensors
        values = gtsam.Values()
        sizes, blocks = {X(0): 6}, [start.covariance]
        values.insert(X(0), as_pose(start.T_map_lidar))
        if self._options.calibration is CalibrationUse.REFINED:
            values.insert(calibration_values(sensors))
            for i, covariance in enumerate(sensors.covariance):
                sizes |= {T(i): 3, D(i): 12}
                blocks.append(covariance)
        return JointGaussian(values, sizes, block_diag(*blocks))

    def _opened(self, tiles: tuple[ExploredTile, ...], first: int) -> OpenSection:
        return OpenSection(self._drive, self._prior, self._options, self.known, tiles, first)

    def _hand_over(self, last: int) -> None:
        self.known, tiles = self._section.closed()
        self.tiles = tiles
        self._section = self._opened(tiles, last)
        self._opened_m, self._first = self._way[last], last
