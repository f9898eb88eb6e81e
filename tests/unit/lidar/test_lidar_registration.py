"""Scans on clouds of rooms: poses to a millimetre, covariances that hold, refusals."""

import sys
from dataclasses import astuple

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray, RigidTransform, Trajectory
from l2m_gtsam.errors import LidarError
from l2m_gtsam.geometry import difference, perturbed
from l2m_gtsam.lidar import surface as surface_module
from l2m_gtsam.lidar.registration import (
    Refusal,
    Registration,
    RegistrationOptions,
    by_scan,
    register,
)
from l2m_gtsam.lidar.surface import Planes, Surface, fitted_planes, smoothed
from l2m_gtsam.storage.cloud import thinned_cloud
from tests.worlds.lidar_rooms import CORRIDOR, ROOM, Room, round_trip, rows, scans, seen, straight

OPTIONS = RegistrationOptions()
BARE = RegistrationOptions(floor_m=0.0, floor_deg=0.0)
OFF = np.array([0.02, -0.02, 0.1, 0.3, -0.2, 0.1])


def cloud(
    room: Room, poses: Trajectory, rng: np.random.Generator, noise_m: float = 0.01
) -> Surface:
    """What a map has of a room, seen along a drive."""
    points = [
        scan.points @ poses.R[k].T + poses.p[k]
        for k, scan in enumerate(scans(room, poses, rng, noise_m))
    ]
    return Surface(smoothed(thinned_cloud(np.concatenate(points), 0.1)))


@pytest.fixture(scope="module")
def room_cloud() -> Surface:
    return cloud(ROOM, rows(round_trip(120), range(0, 120, 6)), np.random.default_rng(1))


def at(poses: Trajectory, k: int) -> RigidTransform:
    return RigidTransform(poses.R[k], poses.p[k])


def scan_at(room: Room, T: RigidTransform, seed: int, noise_m: float = 0.01) -> Surface:
    return Surface(seen(room, T, np.random.default_rng(seed), noise_m), OPTIONS.edge)


def test_planes_of_a_surface_are_fitted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """In whatever pieces they are asked for, with repeats: each is that of its own neighbours."""
    points = np.random.default_rng(3).uniform(0, 2, (60, 3)) * [1, 1, 0.02]
    at_once = Surface(points).planes(np.arange(60))
    fitted = list[int]()

    def counted(point: FloatArray, neighbours: FloatArray) -> Planes:
        fitted.append(len(point))
        return fitted_planes(point, neighbours)

    monkeypatch.setattr(surface_module, "fitted_planes", counted)
    surface = Surface(points)
    for piece in ([5, 3, 5], range(0, 60, 2), range(60), [59, 0]):
        asked = np.array(piece)
        found = surface.planes(asked)
        for one, other in zip(astuple(found), astuple(at_once[asked]), strict=True):
            np.testing.assert_array_equal(one, other)
    assert fitted == [2, 30, 28]


@pytest.mark.parametrize("k", [3, 50, 95])
def test_a_scan_is_found_to_the_millimetre(room_cloud: Surface, k: int) -> None:
    true = at(round_trip(120), k)
    found = register(scan_at(ROOM, true, 7), room_cloud, perturbed(true, OFF), OPTIONS)
    assert found.refusal(OPTIONS) is None
    assert (found.directions, found.share > 0.99) == (6, True)
    # Ranges have 10 mm noise, over 4,000 points; 1 mm is five times the errors' rms.
    np.testing.assert_allclose(found.T.t, true.t, rtol=0, atol=1e-3)
    assert np.linalg.norm(difference(true, found.T)[:3]) < np.deg2rad(0.02)


@pytest.mark.parametrize("noise_m", [0.01, 0.03])
def test_errors_are_what_the_information_says(noise_m: float) -> None:
    """NEES over clouds and scans of their own, 6 is honest; mean of 15 correlated by threes."""
    poses, nees = round_trip(120), []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        surface = cloud(ROOM, rows(poses, range(0, 120, 20)), rng, noise_m)
        for k in (10, 55, 90):
            true = at(poses, k)
            found = register(scan_at(ROOM, true, seed, noise_m), surface, true, BARE)
            error = difference(found.T, true)
            nees.append(error @ found.information @ error)
    # Neighbouring points share planes: sigmas are up to a third too small, never half.
    assert 3.0 < np.mean(nees) < 12.0


def test_along_a_corridor_nothing_is_known() -> None:
    poses = straight(40)
    surface = cloud(CORRIDOR, rows(poses, range(0, 40, 4)), np.random.default_rng(1))
    true = at(poses, 17)
    guess = perturbed(true, np.array([0.01, 0.02, -0.03, 0.4, 0.1, -0.1]))
    found = register(scan_at(CORRIDOR, true, 3), surface, guess, OPTIONS)
    assert found.refusal(OPTIONS) is None
    assert found.directions == 5
    estimate = by_scan(found, guess, OPTIONS)
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert sigma[3] == pytest.approx(OPTIONS.unseen_m, rel=0.01)
    assert np.all(sigma[4:] < 0.05)
    error = difference(estimate.T, true)
    assert np.all(np.abs(error[4:]) < 0.003)
    # It stays where it was expected, although generalised ICP moves it along.
    assert error[3] == pytest.approx(-0.4, abs=0.02)
    assert error @ np.linalg.solve(estimate.covariance, error) < 17  # 1 % of chi2 with 6


def test_another_room_is_refused(room_cloud: Surface) -> None:
    """Floor and ceiling fit everywhere; the walls do not."""
    other = Room(((-9.0, -4.0, 0.0), (6.0, 9.0, 3.5)), (((-2.0, 2.0, 0.0), (0.0, 3.5, 2.0)),))
    true = at(round_trip(120), 0)
    found = register(scan_at(other, true, 1), room_cloud, true, OPTIONS)
    assert found.refusal(OPTIONS) is Refusal.ELSEWHERE
    assert 0.2 < found.share < OPTIONS.least_share


def test_a_floor_alone_is_no_place() -> None:
    """It says how high and how tilted the lidar is, and nothing else."""
    grid = np.stack(np.meshgrid(*[np.arange(-5, 5, 0.2)] * 2), axis=-1).reshape(-1, 2)
    noise = 0.005 * np.random.default_rng(1).standard_normal(len(grid))
    floor = Surface(np.column_stack([grid, noise]))
    still = RigidTransform(np.eye(3), np.zeros(3))
    found = register(floor, floor, still, OPTIONS)
    assert found.directions == 3
    strict = RegistrationOptions(least_directions=4)
    assert found.refusal(strict) is Refusal.UNDETERMINED


def test_a_scan_of_few_points_is_refused(room_cloud: Surface) -> None:
    few = Surface(np.eye(3))
    found = register(few, room_cloud, RigidTransform(np.eye(3), np.zeros(3)), OPTIONS)
    assert isinstance(found, Registration)
    assert found.refusal(OPTIONS) is Refusal.FEW_POINTS


def test_smoothing_thins_walls_and_leaves_the_rest() -> None:
    rng = np.random.default_rng(0)
    sides = rng.uniform(0, 4, (4000, 2))
    wall = np.column_stack([sides, 0.02 * rng.standard_normal(4000)])
    bush: FloatArray = rng.uniform(0, 1, (3000, 3)) + np.array([10, 0, 0])
    smooth = smoothed(np.concatenate([wall, bush]))
    # The mean of 15 neighbours has a quarter of the noise of one; less well at the rim.
    assert np.std(smooth[:4000, 2]) < 0.5 * 0.02
    moved = np.linalg.norm(smooth[4000:] - bush, axis=1)
    assert np.mean(moved == 0) > 0.8


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(LidarError, match=r"small_gicp: pip install 'l2m_gtsam\[lidar\]'"):
        Surface(np.zeros((30, 3)))
