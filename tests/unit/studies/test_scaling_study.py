"""Which sizes the scaling study counts."""

import numpy as np
import pytest

from l2m_gtsam.studies.scaling.measurements import ScalingOptions
from l2m_gtsam.studies.scaling.study import SCALING
from l2m_gtsam.studies.scaling.tasks import MappedDrive
from tests.worlds.exact import dipole_world, drive, random_sensors


def test_sensors_that_the_array_does_not_have_are_not_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("l2m_gtsam.studies.scaling.tasks.solved", lambda *_: None)
    world, sensors = dipole_world(0), random_sensors(0, 2)
    places = np.array([each.t_lidar_mag for each in sensors])
    work = MappedDrive(world, drive(1, sensors, world, count=40), places)
    options = ScalingOptions(sensors=(1, 24), numeric_sensors=0, rounds=1)
    for key, size in (("sensors-01", 1), ("sensors-24", 2)):
        assert {each.size for each in SCALING.compute(options, key, work).measurements} == {size}
