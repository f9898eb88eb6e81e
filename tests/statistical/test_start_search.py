"""How often a start that is looked for is found, and whether what is called unique is true."""

import numpy as np
import pytest

from l2m_gtsam.calibration.view import Compilable
from l2m_gtsam.progress import silent
from l2m_gtsam.records.localisation import StartVerdict
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.start.search import find_start
from tests.drives.slam import calibrated, slam_drive
from tests.worlds.exact import dipole_world, random_sensors
from tests.worlds.surveyed import in_odometry, survey, wandering

HALLS, DRIVES = 5, 20
NEAR = 0.5  # metres


def outcomes(hall: int, options: SlamOptions, seconds: float) -> list[str]:
    """Return what came of the drives of a hall: the verdict, and whether the best place is true."""
    rng = np.random.default_rng(hall)
    world = dipole_world(hall)
    surveyed = survey(world, rng)
    field_map = surveyed.compile() if isinstance(surveyed, Compilable) else surveyed
    told = []
    for number in range(DRIVES):
        sensors = random_sensors(1000 * hall + number, 2)
        drive = slam_drive(world, sensors, wandering(rng, seconds), rng)
        lost, _ = prepared(in_odometry(drive.recording, rng), calibrated(sensors), options)
        found = find_start(lost, field_map, options, silent)
        away = [np.linalg.norm(c.T_map_lidar.t - drive.truth.p[0]) for c in found.candidates]
        right = bool(away) and away[0] < NEAR
        told.append(f"{found.verdict.value} {'right' if right else 'wrong'}")
    return told


@pytest.mark.study
@pytest.mark.parametrize("window_m", [1.0, 3.0, 8.0])
def test_what_is_unique_is_true(window_m: float) -> None:
    """A hundred drives from anywhere: never unique and wrong; over eight metres mostly unique."""
    search = {"window_m": window_m, "longest_m": window_m}
    options = SlamOptions.model_validate({"start": {"anywhere": True, "search": search}})
    told = [each for hall in range(HALLS) for each in outcomes(hall, options, seconds=16)]
    print({each: told.count(each) for each in sorted(set(told))})
    assert told.count(f"{StartVerdict.UNIQUE.value} wrong") == 0
    assert window_m < 8 or told.count(f"{StartVerdict.UNIQUE.value} right") > 0.95 * len(told)
