"""The steel halls of the statistical studies: what they promise to maps and calibrations."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.simulate.hall_drives import CLEARANCE_M, calibration_drive, survey
from l2m_gtsam.simulate.steel_hall import (
    EARTH,
    HALF_AREA,
    STRONG,
    VOXEL_M,
    SteelHall,
    steel_hall,
)
from tests.worlds.hall_clouds import SHIFT_M, CloudVariant, hall_cloud
from tests.worlds.studied_maps import held_out

SEEDS = [0, 1, 2]
SPAN = (0.4, 1.0)  # metres, of a survey: its lowest and its highest pass
STANDING = {"post", "upright", "rack beam", "box"}


@pytest.fixture(scope="module", params=SEEDS)
def seed(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture(scope="module")
def hall(seed: int) -> SteelHall:
    return steel_hall(seed)


@pytest.fixture(scope="module")
def surveyed(hall: SteelHall, seed: int) -> TrainingSet:
    return survey(hall, seed)


def out_of_bodies(hall: SteelHall, points: FloatArray) -> FloatArray:
    """Distance of points to the nearest steel structure, zero within, shape (N,)."""
    boxes = [structure.boxes for structure in hall.steel]
    centres = np.concatenate([b.centres for b in boxes])
    halves = np.concatenate([b.dimensions for b in boxes]) / 2
    over = np.maximum(np.abs(points[:, None] - centres) - halves, 0)
    return np.asarray(np.linalg.norm(over, axis=2).min(axis=1))


def nearest(cloud: FloatArray, points: FloatArray) -> FloatArray:
    """Distance of each point to a cloud, shape (N,)."""
    return np.asarray(cKDTree(cloud).query(points)[0])


def test_a_seed_gives_everything_again() -> None:
    def draw(seed: int) -> list[FloatArray]:
        hall = steel_hall(seed)
        s, d = survey(hall, seed), calibration_drive(hall, seed, (0.4, 1.0))
        cloud = hall_cloud(hall, CloudVariant.SHIFTED_FALSE, seed)
        return [s.points, s.field, held_out(hall, seed, SPAN).field, cloud, d.readings.field]

    first, again, other = draw(3), draw(3), draw(4)
    for a, b, c in zip(first, again, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.shape != c.shape or not np.allclose(a, c)


def test_strength_changes_the_polarisation_of_standing_steel_alone(
    hall: SteelHall, seed: int
) -> None:
    strong = steel_hall(seed, STRONG).world
    np.testing.assert_array_equal(strong.centres, hall.world.centres)
    factor = np.where([kind in STANDING for kind in hall.world.kinds], STRONG, 1.0)
    expected = hall.world.polarisations * factor[:, None]
    np.testing.assert_allclose(strong.polarisations, expected, rtol=1e-15)


def test_all_steel_is_where_it_belongs(hall: SteelHall) -> None:
    """Bars 0.1 m deep at least, beams over 2.8 m, structures on the floor within the area."""
    world = hall.world
    for kind, low, high in (
        ("floor bar", -0.95, -0.1),
        ("floor plate", -0.85, -0.1),
        ("beam", 2.8, 4.2),
        ("post", 0.0, 3.0),
        ("upright", 0.0, 2.0),
    ):
        of_kind = np.array([k == kind for k in world.kinds])
        half = world.dimensions[of_kind, 2] / 2
        assert of_kind.any()
        # Lengths of a post are stacked: rounding of their sum.
        assert (world.centres[of_kind, 2] - half >= low - 1e-12).all()
        assert (world.centres[of_kind, 2] + half <= high + 1e-12).all()
    for structure in hall.steel + hall.timber:
        assert (np.abs(structure.centre) + structure.half < HALF_AREA).all()
    assert len(hall.steel) == len(hall.timber) == 5
    # Nothing magnetic stands where the timber is.
    timber = np.stack([structure.centre for structure in hall.timber])
    assert (out_of_bodies(hall, np.column_stack([timber, np.full(5, 0.5)])) > 0.4).all()


def test_magnitudes_are_those_of_a_hall(hall: SteelHall, surveyed: TrainingSet, seed: int) -> None:
    """A few uT of mild steel, some tens around strong posts (design of the studies)."""
    mild = held_out(hall, seed, SPAN).field - EARTH
    strong_hall = steel_hall(seed, STRONG)
    strong = held_out(strong_hall, seed, SPAN).field - EARTH
    assert 0.8 < mild.std() < 3.0
    assert 3.0 < np.abs(mild).max() < 25.0
    assert 4.0 < strong.std() < 25.0
    bare = steel_hall(seed, posts=0, racks=0)
    floor = bare.world.field(surveyed.points) - EARTH
    assert 0.5 < floor.std() < 3.0


@pytest.mark.parametrize("strength", [1.0, STRONG])
def test_divergence_and_curl_vanish_between_bodies(seed: int, strength: float) -> None:
    hall = steel_hall(seed, strength)
    points = held_out(hall, seed, (0.3, 1.1), 100).points
    step = 1e-3
    columns = [
        (hall.world.field(points + s) - hall.world.field(points - s)) / (2 * step)
        for s in step * np.eye(3)
    ]
    G = np.stack(columns, axis=2)
    # Truncation is step^2 / 6 B''': at 0.4 m from a pole of g uT/m about g * 20 / 0.4^2.
    tolerance = 1e-6 / 6 * 125 * np.abs(G).max()
    assert np.abs(np.trace(G, axis1=1, axis2=2)).max() < tolerance
    assert np.abs(G - np.swapaxes(G, 1, 2)).max() < tolerance
    assert np.median(np.linalg.norm(G, axis=(1, 2))) > 1.0


@pytest.mark.parametrize("heights", [(0.6,), (0.4, 0.9), (0.4, 0.7, 1.0)])
def test_a_survey_covers_the_free_floor(
    hall: SteelHall, seed: int, heights: tuple[float, ...]
) -> None:
    s = survey(hall, seed, heights)
    assert 0.97 * 1500 <= len(s.points) <= 1500
    assert not hall.world.inside(s.points).any()
    assert hall.free(s.points, CLEARANCE_M).all()
    # Floor waves of 4 mm each, three of them.
    off = np.abs(s.points[:, 2, None] - np.array(heights)).min(axis=1)
    assert off.max() <= 0.012 + 1e-12
    truth = held_out(hall, seed, SPAN)
    assert len(truth.points) == 600
    assert hall.free(truth.points, CLEARANCE_M).all()
    # Lanes are 0.4 m apart and waver by 0.1 m: at most half of it from a lane, in the plane, and
    # some more in the corners that lanes leave where they bend.
    assert np.quantile(nearest(s.points[:, :2], truth.points[:, :2]), 0.99) < 0.35
    # ... and it passes beside the structures, not just between them.
    assert np.mean(hall.distance(s.points) < 0.8) > 0.3


def test_survey_noise_is_as_stated(hall: SteelHall, surveyed: TrainingSet) -> None:
    noise = surveyed.field - hall.world.field(surveyed.points)
    # 4,500 draws: the standard deviation is known to 1.1 %, four of its errors are allowed.
    assert noise.std() == pytest.approx(0.2, rel=0.045)


def test_readings_of_a_drive_are_those_of_its_sensors(hall: SteelHall, seed: int) -> None:
    """Noiseless readings, undone, are the world's field where the poses put the sensor."""
    d = calibration_drive(hall, seed, (0.4, 1.0), noise=0.0, sensors=3, count=220)
    assert d.truth().shape == (3, 16)
    for index, sensor in enumerate(d.sensors):
        rows = d.readings.rows_of(index)
        R, p = d.readings.R_map_lidar[rows], d.readings.p_map_lidar[rows]
        places = R @ sensor.t_lidar_mag + p
        b = sensor.distortion.undo(d.readings.field[rows])
        # Rounding of fields of 50 uT, times the condition of C.
        B = np.einsum("nij,nj->ni", R, b)
        np.testing.assert_allclose(B, hall.world.field(places), atol=1e-11)
        assert len(places) == 220
        assert (np.diff(d.readings.stamp_ns[rows]) > 0).all()
        assert hall.free(places, CLEARANCE_M).all()
        assert np.mean(hall.distance(places) < 0.8) > 0.2
        assert np.hypot(*sensor.t_lidar_mag[:2]) <= 0.3 * np.sqrt(2)
        # Waves of 12 mm at most, tilts of 0.1 rad at most on an arm of 0.42 m.
        assert (places[:, 2] > 0.4 - 0.06).all()
        assert (places[:, 2] < 1.0 + 0.06).all()


def test_a_drive_is_planar_and_turns_all_ways(hall: SteelHall, seed: int) -> None:
    d = calibration_drive(hall, seed, (0.4, 1.0))
    turns = Rotation.from_matrix(d.readings.R_map_lidar).as_euler("ZYX")
    tilt = np.rad2deg(turns[:, 1:])
    assert 0.3 < tilt.std() < 3.0
    quadrants = np.bincount(((turns[:, 0] + np.pi) // (np.pi / 2)).astype(int), minlength=4)
    assert (quadrants[:4] > 15).all()
    extent = np.ptp(d.readings.p_map_lidar, axis=0)
    assert (extent[:2] > HALF_AREA).all()
    assert extent[2] < 0.03


def test_clouds_lie_on_bodies_and_cover_them(hall: SteelHall, seed: int) -> None:
    """Voxel means lie on or within a body, or between two parts in one voxel."""
    accurate = hall_cloud(hall, CloudVariant.ACCURATE, seed)
    assert out_of_bodies(hall, accurate).max() < VOXEL_M / 2
    for structure in hall.steel:
        box = structure.boxes
        corners = box.centres[:, None] + box.dimensions[:, None] / 2 * np.array(
            [[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]
        )
        assert nearest(accurate, corners.reshape(-1, 3)).max() < VOXEL_M
    # One point to a voxel of the surface.
    voxels = np.unique(np.floor(accurate / VOXEL_M), axis=0)
    assert len(voxels) == len(accurate)


def test_a_shifted_cloud_is_off_by_three_centimetres(hall: SteelHall, seed: int) -> None:
    """Shifting back every structure, by its own amount, lands on the bodies again."""
    shifted = hall_cloud(hall, CloudVariant.SHIFTED, seed)
    away = out_of_bodies(hall, shifted)
    # Surfaces that face the shift stand out by up to all of it, and no voxel by much more.
    assert 0.7 * SHIFT_M < away.max() < SHIFT_M + VOXEL_M / 2
    accurate = hall_cloud(hall, CloudVariant.ACCURATE, seed)
    for place in np.stack([s.centre for s in hall.steel]):
        a, b = (
            cloud[np.all(np.abs(cloud[:, :2] - place) < 0.7, axis=1)]
            for cloud in (accurate, shifted)
        )
        middle = [(c[:, :2].min(axis=0) + c[:, :2].max(axis=0)) / 2 for c in (a, b)]
        # Voxel borders cut surfaces elsewhere: the extreme means move by up to 2 cm.
        assert np.linalg.norm(middle[1] - middle[0]) == pytest.approx(SHIFT_M, abs=0.02)


def test_false_structures_double_the_cloud(hall: SteelHall, seed: int) -> None:
    accurate = hall_cloud(hall, CloudVariant.ACCURATE, seed)
    doubled = hall_cloud(hall, CloudVariant.FALSE, seed)
    assert hall_cloud(hall, CloudVariant.NONE, seed).shape == (0, 3)
    np.testing.assert_array_equal(doubled[: len(accurate)], accurate)
    false = doubled[len(accurate) :]
    assert 0.6 < len(false) / len(accurate) < 1.6
    assert out_of_bodies(hall, false).min() > 0.4
    # They stand where no reading was taken, as real ones do.
    assert not hall.free(false, 0.01).any()
