"""Modes of processes: their spectra are those of what they stand for."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_factors import PoseMotion, moved
from l2m_gtsam.calibration.budget.found import spread_of_H
from l2m_gtsam.calibration.budget.looked_for import ClockDrift, processes
from l2m_gtsam.calibration.budget.processes import (
    LASTING_S,
    FieldProcess,
    PoseProcess,
    Process,
    ReadingPlaces,
    TimeModes,
    Wander,
    Warp,
)
from l2m_gtsam.calibration.budget.search import FoundProcess
from l2m_gtsam.data import FloatArray, LidarMotion
from l2m_gtsam.records.error_budget import DisturbanceKind
from tests.support.scenes import scene

SECONDS = np.linspace(0.0, 200.0, 801)
PLACES = scene(SECONDS)
READINGS = PLACES.readings
ROWS = np.arange(len(SECONDS))


def test_time_modes_are_orthonormal_and_have_no_mean() -> None:
    modes = TimeModes.over(READINGS, 10).values(READINGS, ROWS)
    gram = modes.T @ modes / len(modes)
    # Both ends of the time count in full here: 1 of 800.
    np.testing.assert_allclose(gram, np.eye(10), atol=6e-3)
    np.testing.assert_allclose(modes.mean(axis=0), 0, atol=4e-3)


def test_each_drive_has_modes_of_its_own() -> None:
    drive = (SECONDS > 120).astype(np.int64)
    readings = replace(READINGS, drive=drive)
    modes = TimeModes.over(readings, 4)
    values = modes.values(readings, ROWS)
    assert values.shape == (len(SECONDS), 8)
    assert not values[drive == 0, 4:].any()
    assert not values[drive == 1, :4].any()
    np.testing.assert_allclose(modes.duration, np.repeat([120.0, 79.75], 4))


def test_a_walk_wanders_as_its_spectrum_says() -> None:
    """Over many walks, coefficients of the modes have the spectrum's variances."""
    rng, count = np.random.default_rng(0), 4000
    steps = rng.standard_normal((count, len(SECONDS))) / np.sqrt(len(SECONDS))
    walks = np.cumsum(steps, axis=1)
    modes = TimeModes.over(READINGS, 6)
    found = (walks @ modes.values(READINGS, ROWS) / len(SECONDS)).var(axis=0)
    _, walk = Wander(PLACES, 0, modes).forms[0]
    # 4,000 draws: 2.2 % a standard deviation; time is not continuous.
    np.testing.assert_allclose(found, walk[::3], rtol=0.12)


@pytest.mark.parametrize("form", range(len(LASTING_S)))
def test_errors_of_poses_have_unit_variance_and_last(form: int) -> None:
    modes = TimeModes.over(READINGS, 400)  # all that matter, unlike the fewer that are looked for
    tilt, heading, floor, height = PoseProcess(PLACES, modes).forms[form]
    np.testing.assert_array_equal(tilt[::6], height[5::6])
    np.testing.assert_array_equal(np.count_nonzero([tilt, heading, floor, height], axis=0), 1)
    variance, values = tilt[::6], modes.values(READINGS, ROWS)
    like = (values[400] * variance) @ values.T
    lasting = LASTING_S[form]
    expected = np.exp(-np.abs(SECONDS - SECONDS[400]) / lasting)
    # Cosines are not the series of this process near the ends, and stop at four a second.
    np.testing.assert_allclose(like[200:600], expected[200:600], atol=0.17)


def test_a_warp_has_a_metre_square_wherever_it_is() -> None:
    warp = Warp.of(PLACES)
    for spectrum in warp.forms[0]:
        variance = warp.modes.values(READINGS.p_map_lidar) ** 2 @ spectrum[::2]
        assert np.mean(variance) == pytest.approx(1)
        assert np.ptp(variance) < 0.3  # cosines are level at ends that are far


def test_features_of_a_warp_are_those_of_poses_on_a_bent_frame() -> None:
    """Shifted, and turned by half the curl, by central differences in a field of one gradient."""
    rng, rows = np.random.default_rng(4), np.arange(40)
    G, B = rng.standard_normal((3, 3)), np.array([20.0, 5.0, -40.0])
    R, p, t = READINGS.R_map_lidar, READINGS.p_map_lidar, PLACES.t

    def field(R: FloatArray, p: FloatArray) -> FloatArray:
        x = np.einsum("nij,nj->ni", R, t) + p
        return np.asarray(np.einsum("nji,nj->ni", R, B + x @ G.T))

    places = replace(PLACES, b_lidar=field(R, p), slope=R.transpose(0, 2, 1) @ G)
    warp = Warp.of(places)
    weights = rng.standard_normal(2 * len(warp.modes.waves))

    def shift(p: FloatArray) -> FloatArray:
        return np.asarray(warp.modes.values(p) @ weights.reshape(-1, 2))

    def bent(size: float) -> FloatArray:
        h = 1e-5
        dx, dy = ((shift(p + h * e) - shift(p - h * e)) / (2 * h) for e in np.eye(3)[:2])
        turn = np.zeros_like(p)
        turn[:, 2] = 0.5 * size * (dx[:, 1] - dy[:, 0])
        moved = p + size * np.column_stack([shift(p), np.zeros(len(p))])
        return field(Rotation.from_rotvec(turn).as_matrix() @ R, moved)

    step = 1e-5
    expected = (bent(step) - bent(-step)) / (2 * step)
    np.testing.assert_allclose(warp.features(rows) @ weights, expected[rows], atol=1e-5)


def test_features_of_wander_add_to_the_readings_along_their_axes() -> None:
    modes, rows = TimeModes.over(READINGS, 2), np.arange(5)
    added = PLACES.C[rows] @ Wander(PLACES, 0, modes).features(rows)
    expected = np.einsum("nj,ia->nija", modes.values(READINGS, rows), np.eye(3)).reshape(5, 3, -1)
    np.testing.assert_allclose(added, expected, atol=1e-12)


@pytest.mark.parametrize("kind", [Wander, FieldProcess, PoseProcess, Warp])
def test_other_readings_feel_the_same_weights(kind: type) -> None:
    """A part of the readings, with the modes of all of them, feels what it feels among all."""
    part = np.arange(300, 420)
    few = ReadingPlaces(
        READINGS[part],
        *(getattr(PLACES, name)[part] for name in ("t", "C", "x", "b_lidar", "slope")),
    )
    modes = TimeModes.over(READINGS, 6)
    every: Process
    if kind is Warp:
        every = Warp.of(PLACES)
    elif kind is Wander:
        every = Wander(PLACES, 0, modes)
    else:
        every = kind(PLACES, modes)
    np.testing.assert_array_equal(
        every.on(few).features(np.arange(len(part))), every.features(part)
    )


def test_features_of_a_clock_are_how_the_field_goes_on() -> None:
    """Along the twist, by central differences, in a field whose gradient is the same all over."""
    rng, rows = np.random.default_rng(2), np.arange(40)
    twist = rng.standard_normal((len(ROWS), 6)) * np.repeat([0.5, 1.0], 3)
    motion = LidarMotion.steady(twist)
    G, B = rng.standard_normal((3, 3)), np.array([20.0, 5.0, -40.0])
    R, t = READINGS.R_map_lidar, PLACES.t

    def field(R: FloatArray, p: FloatArray, t: FloatArray) -> FloatArray:
        x = np.einsum("nij,nj->ni", R, t) + p
        return np.asarray(np.einsum("nji,nj->ni", R, B + x @ G.T))

    places = replace(
        PLACES,
        readings=replace(READINGS, motion=motion),
        b_lidar=field(R, READINGS.p_map_lidar, t),
        slope=R.transpose(0, 2, 1) @ G,
    )
    modes = TimeModes.over(READINGS, 3)
    found = ClockDrift(places, 0, modes).features(rows)
    step, ends = 1e-4, []
    for later in (step, -step):
        on = PoseMotion(twist[rows], np.zeros(len(rows)))
        ends.append(
            field(*moved(R[rows], READINGS.p_map_lidar[rows], on, np.full(40, later)), t[rows])
        )
    rate = (ends[0] - ends[1]) / (2 * step)
    expected = rate[:, :, None] * modes.values(READINGS, rows)[:, None]
    # Third derivatives times the square of the step.
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_clock_is_looked_for_where_the_lidar_moves() -> None:
    kinds = [each.kind for each in processes(PLACES, (0,))]
    assert DisturbanceKind.CLOCK not in kinds
    motion = LidarMotion.steady(np.ones((len(ROWS), 6)))
    moving = replace(PLACES, readings=replace(READINGS, motion=motion))
    clocks = [each for each in processes(moving, (0,)) if each.kind is DisturbanceKind.CLOCK]
    assert [each.sensor for each in clocks] == [0]
    (walk,) = clocks[0].forms[0]
    # A walk of a second from start to end is a sixth of a square second about its mean.
    assert walk.sum() == pytest.approx(1 / 6, rel=0.08)
    assert clocks[0].named(0, np.array([0.04]))["drift_s"] == pytest.approx(0.2)


def test_the_spread_of_H_is_its_mean_square_over_the_drive() -> None:
    rng = np.random.default_rng(1)
    modes = TimeModes.over(READINGS, 24)
    wander = FoundProcess(Wander(PLACES, 0, modes), 0, np.array([0.02, 0.3]), 99.0)
    weights = rng.standard_normal(72)
    drift = modes.values(READINGS, ROWS) @ (np.sqrt(wander.variances) * weights).reshape(24, 3)
    found = spread_of_H(wander, weights, np.zeros((72, 72)))
    # A sum over 801 instants against an integral.
    np.testing.assert_allclose(found, drift.T @ drift / len(drift), atol=0.02 * np.trace(found))
