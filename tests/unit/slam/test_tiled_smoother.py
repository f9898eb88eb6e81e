"""What the covariances of a drive in tiles rest on."""

from dataclasses import replace
from functools import partial

import numpy as np

from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.slam.options import CalibrationUse, DriftOptions, SlamOptions
from l2m_gtsam.slam.unknown_field.tiled_drive import TiledDrive
from l2m_gtsam.slam.unknown_field.tiled_smoother import TiledProblem
from tests.drives.drawn import drawn_drive
from tests.drives.slam import rounds
from tests.drives.uniform import EXACT, PRIOR, UNIFORM
from tests.worlds.exact import random_sensors

NOISY = DriftOptions(position_share=0.1, steady=0.0)
FIXED = SlamOptions(drift=NOISY, calibration=CalibrationUse.FIXED)
# Of sources that are not there: their waves take up noise.
STRONG = replace(PRIOR, hyperparameters=Hyperparameters())


def test_the_penalty_of_complexity_is_no_measurement() -> None:
    """A solved round's graph has readings, priors and odometry; the penalty only guides its poses.

    Its curvature counted as information: sigmas were a tenth too small here, and NEES in halls 10.
    """
    rng = np.random.default_rng(2)
    drawn = drawn_drive(UNIFORM, random_sensors(2, 6), rounds(20), rng, EXACT, every=4, drift=NOISY)
    drive = drawn.drive
    problem = TiledProblem(drive, partial(TiledDrive.lasting, prior=STRONG), FIXED)
    solved = problem.solved(drawn.poses, drive.sensors, 1.0, np.inf)

    rows = solved.graph.linearize(solved.values).jacobian()[0].shape[0]
    waves = sum(len(tile.field) for tile in solved.tiled.tiles)
    assert rows == 3 * len(drive.readings) + waves + 6 * len(drive)
