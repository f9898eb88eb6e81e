"""Faults of drives without a map; minutes of work."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.records.localisation import LocalisationStatus
from tests.drives.exploring import explored
from tests.drives.faults import jumped, shift
from tests.drives.slam import laps, slam_drive
from tests.support.pose_errors import position_error
from tests.worlds.exact import dipole_world, random_sensors


@pytest.mark.study
def test_jumps_of_odometry_do_no_harm_without_a_map() -> None:
    """Half a metre and ten degrees, three times in two laps of 16 m."""
    sensors, truth = random_sensors(1, 4), laps(60, (3.0, 2.0))
    drive = slam_drive(dipole_world(1), sensors, truth, np.random.default_rng(1))
    shifts = shift(300, 0.5, 10.0, 1.0), shift(600, 0.5, -10.0, -2.0), shift(900, 0.5, 10.0)
    odometry = jumped(drive.recording.trajectory, *shifts)
    spoilt = replace(drive, recording=replace(drive.recording, trajectory=odometry))
    found, plain = (explored(each, sensors).result for each in (spoilt, drive))
    assert found.status is LocalisationStatus.LOCALISED
    assert sum("odometry jumps by 0.50 m" in each for each in found.notes) == 3
    error, reference = (position_error(truth, each.trajectory) for each in (found, plain))
    # Three of 1,200 steps are those of their neighbours: as drift of some millimetres.
    assert error < reference + 0.02
