"""Tiles of an unknown field: where they are laid, what they can say, what they learn."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.slam.drive import as_poses
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import MOST_WAVES, SlamOptions, TileOptions
from l2m_gtsam.slam.unknown_field.field_memory import tile_of
from l2m_gtsam.slam.unknown_field.tiles import (
    Anchoring,
    FieldPrior,
    WaveTile,
    anchor_tiles,
    drive_prior,
    field_prior,
    larger,
)
from tests.drives.exploring import COARSE
from tests.drives.moved_steel import moved_steel
from tests.drives.slam import calibrated, laps, slam_drive
from tests.worlds.exact import dipole_world, random_sensors

OPTIONS = TileOptions(core=3.0, modes=150)
PRIOR = FieldPrior(Hyperparameters(), Resolution(4.0, 3.0), OPTIONS)
SIDE, SHIFT = 1e-4, np.eye(3)


def walk(seed: int, steps: int = 120) -> tuple[FloatArray, FloatArray]:
    """Return poses of a vehicle that turns at random, rotations and places in metres."""
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.normal(0, 0.3, steps))
    tilt = rng.normal(0, 0.05, (steps, 2))
    p = np.cumsum(0.3 * np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(steps)]), axis=0)
    return Rotation.from_euler("ZYX", np.column_stack([yaw, tilt])).as_matrix(), p


def tilted(seed: int) -> FloatArray:
    return np.asarray(
        Rotation.from_rotvec(np.random.default_rng(seed).normal(0, 0.3, 3)).as_matrix()
    )


def places(seed: int, count: int = 200) -> FloatArray:
    return np.random.default_rng(seed).uniform([-1.5, -1.5, 0.0], [1.5, 1.5, 0.6], (count, 3))


@given(seed=st.integers(0, 1000), core=st.floats(1.0, 6.0))
@settings(deadline=None, max_examples=30)
def test_every_key_pose_lies_in_the_core_of_its_tile(seed: int, core: float) -> None:
    R, p = walk(seed)
    laid = anchor_tiles(R, p, core)
    anchor = laid.anchor[laid.tile]
    yaw = np.arctan2(R[anchor, 1, 0], R[anchor, 0, 0])
    level = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    away = np.einsum("kji,kj->ki", level, p - p[anchor])
    assert np.abs(away[:, :2]).max() <= core / 2 + 1e-9
    assert np.array_equal(laid.tile[laid.anchor], np.arange(len(laid)))
    assert np.all(laid.anchor[laid.tile] <= np.arange(len(p)))  # a tile begins with its anchor


@given(seed=st.integers(0, 1000), core=st.floats(1.0, 6.0))
@settings(deadline=None, max_examples=30)
def test_tiles_of_a_whole_path_are_those_that_key_pose_after_key_pose_has(
    seed: int, core: float
) -> None:
    R, p = walk(seed)
    poses, anchors, tiles = as_poses(R, p), list[int](), list[int]()
    for k, pose in enumerate(poses):
        number = tile_of(pose, [poses[anchor] for anchor in anchors], core)
        anchors += [k] if number == len(anchors) else []
        tiles.append(number)
    laid = anchor_tiles(R, p, core)
    assert laid.anchor.tolist() == anchors
    assert laid.tile.tolist() == tiles


def test_a_tile_is_come_to_again_after_the_vehicle_was_away() -> None:
    anchoring = Anchoring(np.array([0, 2]), np.array([0, 0, 1, 1, 0, 0, 1]))
    way = np.array([0.0, 1.0, 2.0, 9.0, 10.0, 11.0, 12.0])
    np.testing.assert_array_equal(anchoring.returns(way, 5.0), [4, 5])
    np.testing.assert_array_equal(anchoring.returns(way, 2.5), [4, 5, 6])
    assert not len(anchoring.returns(way, 50.0))


@given(seed=st.integers(0, 1000))
@settings(deadline=None, max_examples=10)
def test_a_tile_obeys_maxwell_whichever_way_its_box_is_turned(seed: int) -> None:
    R, points = tilted(seed), places(seed, 20)
    tile = WaveTile.about(PRIOR, R, points @ R.T)
    at, weights = points @ R.T, np.random.default_rng(seed).normal(size=len(tile))
    field, gradient = tile.field_and_gradient(at, weights)
    np.testing.assert_allclose(tile.features(at) @ weights, field, atol=1e-9)
    numeric = np.stack(
        [
            (
                tile.field_and_gradient(at + SIDE * axis, weights)[0]
                - tile.field_and_gradient(at - SIDE * axis, weights)[0]
            )
            / (2 * SIDE)
            for axis in SHIFT
        ],
        axis=-1,
    )
    scale = np.abs(gradient).max()
    np.testing.assert_allclose(numeric, gradient, atol=1e-5 * scale)  # of a central difference
    assert np.abs(np.trace(gradient, axis1=1, axis2=2)).max() < 1e-9 * scale
    assert np.abs(gradient - gradient.transpose(0, 2, 1)).max() < 1e-9 * scale


def test_the_likely_weights_predict_what_was_not_read() -> None:
    """Readings of a hall in one tile: places between them to a few times the noise."""
    world, noise = dipole_world(3), 0.2
    read, held = places(1, 400), places(2, 100)
    rng = np.random.default_rng(4)
    field = world.field_and_gradient(read)[0] + noise * rng.normal(size=(400, 3))
    prior = field_prior(read, field, OPTIONS)
    tile = WaveTile.about(prior, np.eye(3), read)
    variance = noise**2 + tile.unresolved(read)
    weights = tile.robust_weights(read, field, variance)
    error = tile.field_and_gradient(held, weights)[0] - world.field_and_gradient(held)[0]
    assert np.sqrt(np.mean(error**2)) < 2 * noise
    assert np.std(world.field_and_gradient(held)[0], axis=0).max() > 5 * noise


def test_beside_steel_that_waves_do_not_hold_no_reading_counts() -> None:
    tile = WaveTile.about(PRIOR, np.eye(3), places(0))
    x = np.linspace(-1.5, 1.5, 61)
    points, trust = np.column_stack([x, np.zeros((61, 2))]), np.where(np.abs(x) < 0.32, 0.0, 0.5)
    expected = np.where(np.abs(x) < tile.half_wave + 0.3, 0.0, 0.5)
    np.testing.assert_array_equal(tile.away_from_steel(points, trust), expected)


@pytest.mark.parametrize("apart", [1, 20])
def test_two_wrong_readings_or_some_far_apart_are_no_steel(apart: int) -> None:
    tile = WaveTile.about(PRIOR, np.eye(3), places(0))
    points = np.column_stack([np.linspace(-1.5, 1.5, 61), np.zeros((61, 2))])
    trust = np.ones(61)
    trust[[20, 20 + apart] if apart == 1 else [0, apart, 2 * apart, 3 * apart]] = 0.0
    np.testing.assert_array_equal(tile.away_from_steel(points, trust), trust)


@pytest.mark.parametrize("seed", range(5))
def test_spikes_among_many_readings_are_no_steel(seed: int) -> None:
    tile = WaveTile.about(PRIOR, np.eye(3), places(0))
    rng = np.random.default_rng(seed)
    points, trust = rng.uniform(-1.5, 1.5, (3000, 3)), np.ones(3000)
    trust[rng.random(3000) < 0.08] = 0.0  # some 18 of 225 in a half wave about each
    np.testing.assert_array_equal(tile.away_from_steel(points, trust), trust)


def test_a_prior_is_not_that_of_steel_at_arms_length() -> None:
    made = moved_steel(5)  # a sensor passes the pallet at 0.28 m
    options = SlamOptions.model_validate({"key_poses": COARSE})
    drive, _ = prepared(made.still.recording, calibrated(made.sensors), options)
    learnt = drive_prior(drive, drive.dead_reckoning(), TileOptions()).hyperparameters
    # Most sources are 0.9 to 1.6 m below the sensors.
    assert 0.5 < learnt.floor_depth < 2.0


def test_waves_stay_within_their_number() -> None:
    rough = Resolution(20.0, 12.0).within(OPTIONS.modes, OPTIONS.edge)
    tile = WaveTile.about(FieldPrior(Hyperparameters(), rough, OPTIONS), np.eye(3), places(1))
    # The count is that of a disc of half waves; its rim and the uniform field add to it.
    assert OPTIONS.modes < len(tile) < 1.3 * OPTIONS.modes
    assert rough.floor == rough.ceiling

    # A side that needs fewer leaves its share to the other.
    smooth = Resolution(20.0, 1.0).within(OPTIONS.modes, OPTIONS.edge)
    assert smooth.ceiling == 1.0
    assert smooth.floor > rough.floor
    assert smooth.modes(OPTIONS.edge) == pytest.approx(rough.modes(OPTIONS.edge))
    enough = Resolution(1.0, 1.0)
    assert enough.within(OPTIONS.modes, OPTIONS.edge) == enough


@given(seed=st.integers(0, 1000), count=st.integers(1, 30))
@settings(deadline=None, max_examples=20)
def test_what_waves_leave_out_does_not_average_out_at_one_place(seed: int, count: int) -> None:
    """The mean of n readings of a place: of their noise a share of n is left, of this all."""
    one, noise = places(seed, 1), 0.2
    tile = WaveTile.about(PRIOR, np.eye(3), np.vstack([one, places(seed + 1)]))
    own = tile.unresolved(one)
    np.testing.assert_allclose(tile.unresolved_together(one), own, rtol=1e-12)
    each = noise**2 + tile.unresolved_together(np.repeat(one, count, axis=0))
    np.testing.assert_allclose(1 / np.sum(1 / each, axis=0), noise**2 / count + own[0], rtol=1e-9)


def test_what_waves_leave_out_averages_out_over_a_way() -> None:
    """Places further apart than half of the longest wave that is left out, 0.8 and 1.1 m."""
    apart = np.column_stack([np.arange(-3.0, 3.1, 1.2), np.zeros(6), np.full(6, 0.2)])
    tile = WaveTile.about(PRIOR, np.eye(3), apart)
    np.testing.assert_allclose(tile.unresolved_together(apart), tile.unresolved(apart), rtol=1e-12)


def test_a_prior_is_not_learnt_from_nothing() -> None:
    with pytest.raises(MapError, match="training readings"):
        field_prior(np.zeros((3, 3)), np.ones((3, 3)), OPTIONS)


def test_few_waves_teach_of_the_sources_what_many_do() -> None:
    """Along odometry in a hall of which windows of 200 waves hold a part.

    With the same factor for floor and ceiling strength came out 1.6 times as large.
    """
    own = random_sensors(11, 4)
    driven = slam_drive(dipole_world(11), own, laps(25.0, (1.9, 1.4)), np.random.default_rng(11))
    frequent = SlamOptions.model_validate({"key_poses": {"distance_m": 0.1, "readings": 2}})
    drive, _ = prepared(driven.recording, calibrated(own), frequent)
    few, many = (
        drive_prior(drive, drive.dead_reckoning(), TileOptions(modes=modes)).hyperparameters
        for modes in (200, 450)
    )
    # A fifth is a third of what strength was off by with the same factor.
    assert few.floor_scale == pytest.approx(many.floor_scale, rel=0.2)
    assert few.floor_depth == pytest.approx(many.floor_depth, rel=0.2)
    assert few.noise == pytest.approx(many.noise, rel=0.2)


def test_a_side_too_weak_for_any_wave_is_left_out() -> None:
    """A ceiling so far off that readings could tell none of its waves."""
    weak = FieldPrior(Hyperparameters(), Resolution(4.0, 0.1), OPTIONS)
    tile = WaveTile.about(weak, np.eye(3), places(3))
    assert len(tile) == len(WaveTile.about(PRIOR, np.eye(3), places(3)).basis.families[1]) + 3
    assert tile.features(places(4)).shape == (200, 3, len(tile))


def test_larger_tiles_at_last_have_waves_as_short() -> None:
    options = TileOptions(core=3.0, modes=200, last_core=5.0)
    assert (options.last.core, options.last.edge) == (5.0, 6.5)
    assert TileOptions(core=6.0).last == TileOptions(core=6.0)  # never smaller
    prior = FieldPrior(Hyperparameters(), Resolution(4.0, 3.0), options)
    ahead = larger(prior)
    assert ahead.resolution == prior.resolution
    # As many for each square metre of the box; a count of waves on a lattice, not its area.
    few, many = (len(WaveTile.about(each, np.eye(3), places(1))) for each in (prior, ahead))
    assert many / few == pytest.approx((6.5 / 4.5) ** 2, rel=0.1)


def test_the_largest_tiles_have_no_more_waves_than_any_may_have() -> None:
    wide = TileOptions(modes=1000, last_core=20.0)
    ahead = larger(FieldPrior(Hyperparameters(), Resolution(8.0, 8.0), wide))
    assert ahead.resolution.floor < 8.0
    assert len(WaveTile.about(ahead, np.eye(3), places(1))) < 1.1 * MOST_WAVES  # as above
