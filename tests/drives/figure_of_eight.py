"""A smooth drive along a figure of eight through an exact field."""

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSeries, KnownSensor, Recording, SourceFile, Trajectory
from tests.worlds.exact import DipoleWorld

STEP_NS = 50_000_000


def recorded_drive(world: DipoleWorld, sensors: tuple[KnownSensor, ...]) -> Recording:
    """Half a minute on a figure of eight, pitching and rolling; poses without noise at 20 Hz."""
    s = np.arange(0, 30.0, STEP_NS * 1e-9)
    angles = np.column_stack([0.5 * s, 0.2 * np.sin(1.1 * s), 0.2 * np.cos(1.7 * s)])
    R = Rotation.from_euler("ZYX", angles).as_matrix()
    p = np.column_stack([3 * np.sin(0.3 * s), 2 * np.sin(0.6 * s), 0.5 + 0.1 * np.sin(0.9 * s)])
    stamps = 1_700_000_000_000_000_000 + np.arange(len(s)) * STEP_NS
    rng = np.random.default_rng(0)
    series = []
    for sensor in sensors:
        B, _ = world.field_and_gradient(np.einsum("nij,j->ni", R, sensor.t_lidar_mag) + p)
        field = sensor.distortion.apply(np.einsum("nji,nj->ni", R, B))
        field += 0.1 * rng.normal(size=field.shape)
        series.append(FieldSeries(sensor.sensor, "/" + sensor.sensor, "mag", stamps, field))
    trajectory = Trajectory(stamps, R, p, "map", "lidar")
    return Recording(trajectory, tuple(series), SourceFile("drive.bag", "ab12"))
