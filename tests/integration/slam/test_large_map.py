"""A drive over so many tiles of a map that their errors are not all in one system."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.progress import silent
from l2m_gtsam.slam import map_errors
from l2m_gtsam.slam.localisation import Localisation, localise
from l2m_gtsam.slam.map_errors import by_place, halved
from l2m_gtsam.slam.options import SlamOptions
from tests.drives.online import Hall, online_hall
from tests.drives.slam import COARSE, calibrated
from tests.drives.uncertain import GIVEN, OPTIONS
from tests.worlds.exact import dipole_world

CHOSEN = SlamOptions.model_validate({"key_poses": COARSE, "calibration": "fixed"})


@pytest.fixture(scope="module")
def hall() -> Hall:
    return online_hall()


@pytest.fixture(scope="module")
def field_map(hall: Hall) -> HarmonicMap:
    """A survey around the drive's path, in more than thirty tiles."""
    rng, p = np.random.default_rng(5), hall[1].truth.p
    points = np.repeat(p[:: max(len(p) // 300, 1)], 8, axis=0)
    points = points + rng.uniform(-0.6, 0.6, points.shape)
    field = dipole_world(1).field_and_gradient(points)[0] + rng.normal(0, GIVEN.noise, points.shape)
    return HarmonicMap.fit(points, field, OPTIONS)


def localised(hall: Hall, field_map: HarmonicMap) -> Localisation:
    sensors, drive = hall
    return localise(drive.recording, field_map.compile(), calibrated(sensors), CHOSEN, silent)


def sigmas(found: Localisation) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("kii->ki", found.solution.pose_covariance)))


def test_groups_of_tiles_solve_nearly_what_all_together_do(
    hall: Hall, field_map: HarmonicMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses within a third of a sigma, sigmas within a tenth on average: groups of six tiles are
    nearly all border, where errors in common are left out."""
    whole = localised(hall, field_map)
    monkeypatch.setattr(map_errors, "MOST_TILES", 6)
    grouped = localised(hall, field_map)
    before, after = sigmas(whole), sigmas(grouped)
    away = [
        np.linalg.norm(one.translation() - other.translation())
        for one, other in zip(whole.solution.poses, grouped.solution.poses, strict=True)
    ]
    assert np.max(np.array(away) / np.linalg.norm(before[:, 3:], axis=1)) < 1 / 3
    assert_allclose(np.mean(np.log(after / before), axis=0), 0, atol=0.1)


def test_groups_are_all_tiles_near_each_other(field_map: HarmonicMap, hall: Hall) -> None:
    points = hall[1].truth.p
    tile = field_map.tile_of(points)
    parts = list(by_place(field_map, points, 5))
    assert_allclose(np.sort(np.concatenate(parts)), np.arange(len(points)))
    owners = [set(tile[rows].tolist()) for rows in parts]
    assert len(parts) > 3
    assert max(map(len, owners)) <= 5
    assert sum(map(len, owners)) == len(set(tile.tolist()))


def test_few_tiles_are_one_group(field_map: HarmonicMap, hall: Hall) -> None:
    (rows,) = by_place(field_map, hall[1].truth.p, 10_000)
    assert len(rows) == len(hall[1].truth.p)


def test_tiles_are_halved_across_the_longer_side() -> None:
    """A corridor of twelve metres: four parts of three tiles, one after the other."""
    centre = np.column_stack([np.arange(12.0), np.tile([0.0, 0.5], 6)])
    parts = list(halved(np.arange(12), centre, 3))
    assert [sorted(each.tolist()) for each in parts] == [
        [0, 1, 2],
        [3, 4, 5],
        [6, 7, 8],
        [9, 10, 11],
    ]
