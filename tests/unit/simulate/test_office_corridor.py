"""Office corridors: closed forms of their parts, a field without sources in the air, drives."""

import numpy as np
import pytest

from l2m_gtsam.simulate.office_corridor import Rods, Sheets, office_corridor
from l2m_gtsam.simulate.office_drives import office_drive, survey_way

SEED = 3
HEIGHTS = (0.4, 0.7, 1.0)


def test_the_field_in_the_middle_of_a_sheet() -> None:
    """Of a current round a rectangle, 2 mu0 I sqrt(a^2 + b^2) / (pi a b), with the right hand."""
    a, b, current = 0.6, 1.1, 12.0
    sheet = Sheets(
        np.array([[1.0, 2.0, 3.0]]),
        np.array([[a, 0.0, 0.0]]),
        np.array([[0.0, b, 0.0]]),
        np.array([current]),
    )
    middle = np.array([[1.0 + a / 2, 2.0 + b / 2, 3.0]])
    expected = 0.8 * current * np.hypot(a, b) / (a * b)  # 2 mu0 / pi in uT m / A
    np.testing.assert_allclose(sheet.field(middle), [[0.0, 0.0, expected]], atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_far_off_rods_and_sheets_are_dipoles(axis: int) -> None:
    """A rod has the moment pole times length, a sheet current times area."""
    side, other = np.roll(np.eye(3), 2 - axis, axis=0)[:2] * 0.1
    along = np.cross(side, other) / 0.1**2
    sheet = Sheets(-0.5 * (side + other)[None], side[None], other[None], np.array([300.0]))
    rod = Rods(-0.1 * along[None], 0.1 * along[None], np.array([15.0]))
    points = 20 * np.random.default_rng(1).normal(size=(30, 3))
    r = np.linalg.norm(points, axis=1, keepdims=True)
    m = 3.0 * along
    dipole = 0.1 * (3 * points * (points @ m)[:, None] / r**5 - m / r**3)
    # Next are octupoles: smaller by the square of the size over the distance.
    near = 3 * (0.2 / r.min()) ** 2 * np.abs(dipole).max()
    np.testing.assert_allclose(rod.field(points), dipole, atol=near)
    np.testing.assert_allclose(sheet.field(points), dipole, atol=near)


def test_in_the_air_the_field_has_neither_source_nor_whirl() -> None:
    office, step = office_corridor(SEED), 1e-4
    points = survey_way(office, SEED, HEIGHTS, 60)
    gradient = np.stack(
        [
            (office.field(points + e) - office.field(points - e)) / (2 * step)
            for e in step * np.eye(3)
        ],
        axis=2,
    )
    size = np.abs(gradient).max()
    assert size > 1  # uT/m
    # Differences of 1e-4 m: rounding is 1e-15 * 60 uT / 1e-4 m, the rest its square.
    np.testing.assert_allclose(np.trace(gradient, axis1=1, axis2=2), 0, atol=1e-5 * size)
    np.testing.assert_allclose(gradient, gradient.transpose(0, 2, 1), atol=1e-5 * size)


def test_a_drive_reads_the_field_where_its_sensors_are() -> None:
    office = office_corridor(SEED)
    drive = office_drive(office, 5, (0.4, 1.0), 0.2, 2, 300)
    again = office_drive(office_corridor(SEED), 5, (0.4, 1.0), 0.2, 2, 300)
    np.testing.assert_array_equal(drive.readings.field, again.readings.field)
    R, p = drive.readings.R_map_lidar, drive.readings.p_map_lidar
    np.testing.assert_allclose(
        R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12
    )
    for index, sensor in enumerate(drive.sensors):
        own = drive.readings.rows_of(index)
        places = R[own] @ sensor.t_lidar_mag + p[own]
        assert office.free(places).all()
        b = np.einsum("nji,nj->ni", R[own], office.field(places))
        noise = drive.readings.field[own] - sensor.distortion.apply(b)
        # 900 draws: a standard deviation is known to 2.4 %.
        assert noise.std() == pytest.approx(0.2, rel=0.1)


def test_what_the_lidar_sees_stands_inside_the_corridor() -> None:
    office = office_corridor(SEED)
    cloud = office.cloud()
    assert len(cloud) > 300
    assert np.abs(cloud[:, 1]).max() < 1.5
    assert cloud[:, 2].min() >= -1e-9  # bars in the floor and rails in the shaft are not seen
