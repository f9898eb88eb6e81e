"""What is wrong on the drives of the troubles study, and what its summary counts."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.parts_alone import ByParts, PartsRatio
from l2m_gtsam.data import Distortion, FloatArray, KnownSensor, Trajectory
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.studies.troubles.cells import JudgedSensor, TroublesCell, held_alone
from l2m_gtsam.studies.troubles.drives import (
    bent,
    linear_over,
    noise_that_lasts,
    not_linear,
    pink,
    troubled_drive,
    walk,
)
from l2m_gtsam.studies.troubles.options import Trouble, TroublesOptions, World
from l2m_gtsam.studies.troubles.study import (
    TROUBLES,
    CellName,
    TroublesSummary,
    kind,
    row_of,
)
from l2m_gtsam.studies.troubles.surveys import TroubledPlace, known_suite, place_of, survey_of

OPTIONS = TroublesOptions(surveys=2, drives=1)


def test_pink_noise_falls_with_frequency() -> None:
    noise = pink(4096, np.random.default_rng(0))
    np.testing.assert_allclose(noise.std(axis=0), 1.0)
    power = (np.abs(np.fft.rfft(noise, axis=0)) ** 2).mean(axis=1)
    slow, fast = power[8:32].mean(), power[512:2048].mean()
    # One over frequency: 18 against 1,180 on average, by 90 draws of exponentials and more.
    assert slow / fast == pytest.approx(65, rel=0.35)


def test_each_trouble_is_of_the_size_that_is_told() -> None:
    rng, count = np.random.default_rng(1), 400
    field, seconds = rng.normal(0, 30, (count, 3)), np.linspace(0, 60, count)
    size = {
        trouble: np.concatenate(
            [
                walk(OPTIONS, trouble, seconds, rng)
                + noise_that_lasts(OPTIONS, trouble, count, rng)
                for _ in range(40)
            ],
            axis=1,
        )
        for trouble in Trouble
    }
    for trouble in (Trouble.CLEAN, Trouble.SUITE, Trouble.POSES, Trouble.WARP):
        assert not size[trouble].any()
    # 120 draws of a normal number.
    assert size[Trouble.DRIFT][-1].std() == pytest.approx(OPTIONS.drift_ut, rel=0.25)
    assert size[Trouble.PINK].std() == pytest.approx(OPTIONS.pink_ut, rel=0.01)
    expected = OPTIONS.nonlinear * np.abs(field) * np.abs(field) / 50
    np.testing.assert_allclose(np.abs(not_linear(OPTIONS, field, rng)), expected)
    assert (size[Trouble.ALL].std(axis=0) > size[Trouble.PINK].std(axis=0).min()).mean() > 0.8


def test_of_a_scale_that_is_not_linear_the_nearest_linear_one_is_true() -> None:
    rng = np.random.default_rng(3)
    b_lidar = rng.normal(0, 20, (500, 3)) + np.array([0, 0, -40])
    sensor = KnownSensor("mag", np.zeros(3), Distortion(1.1 * np.eye(3), np.array([1.0, 2, 3])))
    field = sensor.distortion.apply(b_lidar)
    change = not_linear(OPTIONS, field, rng)
    near = linear_over(sensor, field, change)
    left = field + change - near.distortion.apply(b_lidar)
    # Nothing that is linear in the fields is left.
    np.testing.assert_allclose(left.mean(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(b_lidar.T @ left, 0, atol=1e-6)
    assert np.square(left).sum() < 0.5 * np.square(change).sum()


@pytest.mark.parametrize("seed", [700, 702])
def test_the_offsets_of_all_sensors_jump_at_one_moment(seed: int) -> None:
    unmapped: Any = None
    place = TroubledPlace(place_of(World.HALL, seed), unmapped)
    clean, jumped = (
        troubled_drive(OPTIONS, place, trouble, 0)[0].series
        for trouble in (Trouble.CLEAN, Trouble.JUMP)
    )
    last_before, first_after = [], []
    for one, other in zip(clean, jumped, strict=True):
        after = (one.field != other.field).any(axis=1)
        last_before.append(one.stamp_ns[~after].max())
        first_after.append(one.stamp_ns[after].min())
    assert max(last_before) < min(first_after)


def test_a_bent_frame_moves_places_and_turns_them_by_half_its_curl() -> None:
    """By central differences of the shifts."""
    at, h = np.linspace(0, 50, 200), 1e-6
    p = np.column_stack([5 * np.cos(at), 3 * np.sin(at), 0 * at])
    R = np.broadcast_to(np.eye(3), (200, 3, 3))

    def shifted(by: FloatArray) -> Trajectory:
        true = Trajectory((1e9 * at).astype(np.int64), R, p + by, "map", "lidar")
        return bent(true, OPTIONS, np.random.default_rng(2))

    moved = shifted(np.zeros(3))
    shift = moved.p - p
    assert not shift[:, 2].any()
    assert 0 < np.abs(shift).max() <= OPTIONS.warp_m
    dx, dy = ((shifted(h * e).p - shifted(-h * e).p) / (2 * h) for e in np.eye(3)[:2])
    turn = Rotation.from_matrix(moved.R).as_rotvec()
    np.testing.assert_allclose(turn[:, 2], 0.5 * (dx[:, 1] - dy[:, 0]), atol=1e-8)
    np.testing.assert_array_equal(turn[:, :2], 0)
    assert 0 < np.abs(turn).max() < np.deg2rad(1)


@pytest.mark.parametrize("world", list(World))
def test_a_survey_reads_where_its_suite_is(world: World) -> None:
    place = place_of(world, OPTIONS.seed)
    survey, suite = survey_of(place, OPTIONS), known_suite(OPTIONS)
    recording = survey.recorded(suite, place, OPTIONS, off=False)
    wrong = survey.recorded(suite, place, OPTIONS, off=True)
    for index, (name, known) in enumerate(suite.items()):
        own = survey.sensor == index
        R, field = survey.R[own], recording.series[index].field
        expected = place.built.field(R @ known.t_lidar_mag + survey.p[own])
        read = np.einsum("nij,nj->ni", R, field)
        assert recording.series[index].sensor == name
        # Readings of 0.2 uT of noise and no other error.
        assert (read - expected).std() == pytest.approx(OPTIONS.noise, rel=0.1)
        # 0.3 uT of H and half a per cent of 50 uT, nine at a time.
        assert 0.05 < np.sqrt(np.mean((wrong.series[index].field - field) ** 2)) < 1.5


def judged(level: Level, distance: float | None) -> JudgedSensor:
    known = None if distance is None else 0.01
    return JudgedSensor(level.value, distance, distance, known, known, 1.0)


@pytest.mark.parametrize(("distance", "holds"), [(2 * 3 * 3.23, True), (2 * 3 * 3.25, False)])
def test_the_check_alone_takes_the_larger_scatter(distance: float, holds: bool) -> None:
    """Of eight parts by time or by place; with 3 and 16 degrees of freedom up to 3 * 3.24."""
    truth = KnownSensor.ideal("mag")
    values, freedoms = (1.0, 2.0, 1.0, 1.5), (32.0, 16.0, 32.0, 8.0)
    ratios = tuple(PartsRatio(v, 3.0, n) for v, n in zip(values, freedoms, strict=True))
    vector = truth.vector() + np.append(np.sqrt(distance), np.zeros(14))
    found = ByParts(0, vector, np.eye(15), dict.fromkeys("tCH", ratios))
    assert held_alone(found, truth) == {"t": holds, "C": True, "H": True}


def test_what_the_check_alone_holds_is_counted() -> None:
    sensor = judged(Level.PASS, 3.0)
    found = [replace(sensor, alone={"t": held, "C": True, "H": True}) for held in (True, False)]
    row = row_of(World.HALL, Trouble.CLEAN, [*found, sensor])
    assert row.alone_t is not None
    assert (row.alone_t.successes, row.alone_t.trials) == (1, 2)
    assert row_of(World.HALL, Trouble.CLEAN, [sensor]).alone_C is None


def test_conditions_are_counted() -> None:
    cells = {
        key: TroublesCell(
            CellName.of(key).world,
            CellName.of(key).trouble,
            CellName.of(key).survey,
            (judged(Level.PASS, 10.0), judged(Level.WARN, 1000.0), judged(Level.FAIL, None)),
        )
        for key in TROUBLES.keys(OPTIONS)
    }
    summary = TROUBLES.summarise(OPTIONS, cells)
    assert [row.trouble for row in summary.rows] == 2 * list(Trouble)
    assert [row.world for row in summary.rows] == [each for each in World for _ in Trouble]
    for row in summary.rows:
        assert row.levels == (2, 2, 2)
        assert row.determined == 4
        assert row.nees == 505.0
        assert row.passed is not None
        assert row.passed.rate == 1.0
        assert row.passed_t is not None
        assert row.passed_t.rate == 0.0  # 10 is beyond 7.8
        assert row.held is not None
        assert row.held.rate == 0.5
    page = TROUBLES.page(summary)
    assert "| suite-stated | 2, 2, 2 |" in page
    assert set(TROUBLES.figures(summary)) == {"troubles"}


@pytest.mark.parametrize(
    ("world", "places", "others"),
    [("hall", "2 halls of", "corridor"), ("office", "2 office", "hall")],
)
def test_the_page_tells_of_the_places_that_there_are(world: str, places: str, others: str) -> None:
    options = TroublesOptions(surveys=2, worlds=(World(world),))
    row = row_of(World(world), Trouble.CLEAN, [judged(Level.PASS, 10.0)])
    page = TROUBLES.page(TroublesSummary(options, (row,)))
    assert page.startswith(places)
    assert others not in page.lower()


def test_conditions_of_one_map_follow_each_other() -> None:
    """The map of a survey is made once."""
    sites = [TROUBLES.site(OPTIONS, key) for key in TROUBLES.keys(OPTIONS)]
    changes = sum(a != b for a, b in pairwise(sites))
    assert changes == len(set(sites)) - 1
    assert kind(Trouble.ALL) is Trouble.SUITE
