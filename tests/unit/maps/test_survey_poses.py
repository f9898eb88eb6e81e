"""Errors of the poses of a survey, carried by the map that was made of its readings."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.build import map_from_state
from l2m_gtsam.maps.harmonic.evidence import SharedNoise, condition, evidence, normal_of
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.history import History
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.harmonic.pose_sizes import MOST_READINGS, pose_view
from l2m_gtsam.maps.harmonic.search import SearchOptions
from l2m_gtsam.maps.harmonic.tile_correlation import shared_poses, within_whole
from l2m_gtsam.maps.harmonic.tiles import Tiles
from l2m_gtsam.maps.suite_errors import SHIFT, SIZE, SuiteErrors
from l2m_gtsam.maps.survey_poses import KNOTS, SurveyPoses
from l2m_gtsam.maps.training import TrainingSet, cubes_of, errors_together
from l2m_gtsam.records.map_diary import UNDATED
from tests.worlds.exact import DipoleWorld, dipole_world
from tests.worlds.harmonic import GIVEN, basis, places, rms

TILT, LASTING_S, NOISE, SPEED = np.deg2rad(0.6), 2.0, 0.1, 0.3
EARTH = np.array([15.0, 8.0, -44.0])
SIDE = 2.4
NO_SEARCH = HarmonicOptions(search=SearchOptions(rounds=0))


def errors(count: int, seed: int = 0, lasting_s: float = 2.0) -> SurveyPoses:
    """Return errors of so many readings of two drives."""
    rng = np.random.default_rng(seed)
    drive = np.arange(count) % 2
    seconds = np.sort(rng.uniform(0, 60, count))
    shift = rng.normal(size=(count, 6, 6))
    return SurveyPoses(np.arange(count), drive, seconds, shift, lasting_s, stated=True)


@given(st.integers(0, 2**32 - 1))
def test_averages_have_the_average_effect(seed: int) -> None:
    rng, count = np.random.default_rng(seed), 30
    poses = errors(count, seed)
    owner = np.concatenate([np.arange(6), rng.integers(0, 6, count - 6)])
    weight, slope = rng.uniform(0.5, 5, count), rng.normal(size=(6, 3, 3))
    told = poses.averaged(owner, weight).knots(np.arange(6), slope)
    single = poses.knots(np.arange(count), slope[owner])
    np.testing.assert_array_equal(told.knots.seconds, single.knots.seconds)
    for each in range(6):
        own = owner == each
        expected = np.average(single.effect[own], axis=0, weights=weight[own])
        # Averages are in single precision, as in files.
        np.testing.assert_allclose(told.effect[each], expected, atol=1e-5)


def test_errors_have_their_variance_at_any_time_and_last_as_long_as_stated() -> None:
    poses = errors(200, lasting_s=5.0)
    even = np.concatenate([np.zeros((200, 3, 6)), np.tile(np.eye(3, 6), (200, 1, 1))], axis=1)
    white = replace(poses, shift=even).knots(np.arange(200), np.zeros((200, 3, 3))).white
    covariance = np.einsum("nik,mik->nm", white, white) / 3
    np.testing.assert_allclose(covariance.diagonal(), 1.0, atol=1e-6)
    apart = np.abs(poses.seconds[:, None] - poses.seconds)
    expected = np.where(poses.drive[:, None] == poses.drive, np.exp(-apart / 5.0), 0.0)
    # Between two knots the process is a line: half a spacing of 2.5 s off at most.
    assert np.abs(covariance - expected).max() < 1 - np.exp(-1 / KNOTS)


def test_two_surveys_have_nothing_in_common() -> None:
    one, other = errors(10), errors(6, seed=1)
    both = errors_together(one, other, 10)
    assert both is not None
    assert not set(both.drive[:10]) & set(both.drive[10:])
    np.testing.assert_array_equal(both.reading, np.arange(16))
    assert errors_together(None, None, 4) is None
    late = errors_together(None, other, 10)
    assert late is not None
    np.testing.assert_array_equal(late.reading, other.reading + 10)


def shared(count: int, seed: int = 0) -> SharedNoise:
    rng = np.random.default_rng(seed)
    return SharedNoise(rng.normal(size=(count, 3, 7)), rng.uniform(0.5, 4, count), GIVEN.noise)


def dense(noise: SharedNoise) -> FloatArray:
    E = noise.errors.reshape(-1, noise.errors.shape[2])
    return np.diag(np.repeat(noise.noise**2 / noise.weight, 3)) + E @ E.T


def test_shared_noise_is_that_of_its_matrix() -> None:
    noise, values = shared(20), np.random.default_rng(1).normal(size=(20, 3, 4))
    expected = GIVEN.noise**2 * np.linalg.solve(dense(noise), values.reshape(60, 4))
    np.testing.assert_allclose(noise.given(values).reshape(60, 4), expected, atol=1e-10)


def test_likelihood_and_posterior_are_those_of_the_whole_matrix() -> None:
    model, noise = basis(), shared(600)
    points = model.frame.corner + places(600) @ model.frame.R_map_tile.T
    field = np.random.default_rng(2).normal(0, 3, (600, 3))
    readings = TrainingSet(points, field, noise.weight)
    log_variance = model.prior(GIVEN).log_variance
    normal = normal_of(model, readings, noise)
    F, S, N, y = (
        model.features(points).reshape(1800, -1),
        np.exp(log_variance),
        dense(noise),
        field.ravel(),
    )
    C = (F * S) @ F.T + N
    _, log_det = np.linalg.slogdet(2 * np.pi * C)
    expected = -0.5 * (y @ np.linalg.solve(C, y) + log_det)
    assert evidence(normal, log_variance, GIVEN.noise).value == pytest.approx(expected, rel=1e-8)
    weights = condition(normal, log_variance, GIVEN.noise)
    mean = S * (F.T @ np.linalg.solve(C, y))
    np.testing.assert_allclose(F @ weights.mean, F @ mean, atol=1e-5)


@dataclass(frozen=True)
class Survey:
    """Lanes along x and y, each a drive, with the effect of a unit of each error of a pose."""

    points: FloatArray
    field: FloatArray
    poses: SurveyPoses


def survey(world: DipoleWorld, tilt: float, seed: int = 0) -> Survey:
    rng = np.random.default_rng(seed)
    along = np.arange(0, SIDE, 0.06)
    lanes = np.arange(0.1, SIDE, 0.3)
    points, drive, seconds = [], [], []
    for number, lane in enumerate([*lanes, *lanes]):
        across = np.full_like(along, lane)
        pair = (along, across) if number < len(lanes) else (across, along)
        points.append(np.column_stack([*pair, np.zeros_like(along)]))
        drive.append(np.full(len(along), number))
        seconds.append(along / SPEED)
    x, of, at = np.concatenate(points), np.concatenate(drive), np.concatenate(seconds)
    true = world.field_and_gradient(x)[0] + EARTH
    turn = np.column_stack([process(of, at, rng) for _ in range(2)] + [np.zeros(len(x))])
    field = true + np.cross(tilt * turn, true) + rng.normal(0, NOISE, x.shape)
    shift = np.zeros((len(x), 6, 6))
    shift[:, :3, 3:] = -np.eye(3)
    shift[:, 3:, :3] = np.cross(field[:, None], np.eye(3)).transpose(0, 2, 1)
    poses = SurveyPoses(np.arange(len(x)), of, at, shift, LASTING_S, stated=False)
    return Survey(x, field, poses)


def process(drive: IntArray, seconds: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return an Ornstein-Uhlenbeck process of unit variance along each drive."""
    apart = np.abs(seconds[:, None] - seconds) / LASTING_S
    same = drive[:, None] == drive
    root = np.linalg.cholesky(np.where(same, np.exp(-apart), 0.0) + 1e-9 * np.eye(len(drive)))
    return np.asarray(root @ rng.normal(size=len(drive)))


@pytest.fixture(scope="module")
def world() -> DipoleWorld:
    quiet = dipole_world(4, count=14)
    return replace(quiet, moments=15 * quiet.moments)


@pytest.fixture(scope="module")
def exact(world: DipoleWorld) -> HarmonicMap:
    """The map of a survey whose poses are wrong and count as exact."""
    seen = survey(world, TILT)
    return HarmonicMap.fit(seen.points, seen.field, NO_SEARCH)


def scores(ours: HarmonicMap, world: DipoleWorld) -> FloatArray:
    """Return the map's errors over their standard deviations inside the survey."""
    at = np.column_stack(
        [np.random.default_rng(5).uniform(0.2, SIDE - 0.2, (400, 2)), np.zeros(400)]
    )
    found, _ = ours.field_and_gradient(at)
    truth = world.field_and_gradient(at)[0] + EARTH
    return np.asarray((found - truth) / np.sqrt(ours.variance(at)))


def test_poses_that_are_wrong_are_found_and_held_by_the_sigmas(
    world: DipoleWorld, exact: HarmonicMap
) -> None:
    """Errors over sigmas: 2.9 for exact poses, 1.3 with what is found, 1.5 with what is stated.

    So few lanes share so few errors that one survey scatters by some tenths.
    """
    seen = survey(world, TILT)
    ours = HarmonicMap.fit(seen.points, seen.field, NO_SEARCH, None, None, seen.poses)
    found = ours.learnt.poses
    assert found is not None
    assert found.sizes is not None
    assert 0.7 < found.sizes[0] / TILT < 1.3
    assert "deg of tilt" in ours.summary.doubts[0]
    units = seen.poses.shift * np.array([TILT, TILT, 0, 0, 0, 0])
    told = replace(seen.poses, shift=units, stated=True)
    stated = HarmonicMap.fit(seen.points, seen.field, NO_SEARCH, None, None, told)
    for each in (ours, stated):
        assert rms(scores(each, world)) < 0.6 * rms(scores(exact, world))
        # Most of what the map took for noise was none.
        assert NOISE / 1.5 < each.learnt.hyperparameters.noise < 1.5 * NOISE


def test_poses_that_are_exact_are_not_found_wrong(world: DipoleWorld) -> None:
    seen = survey(world, 0.0)
    ours = HarmonicMap.fit(seen.points, seen.field, NO_SEARCH, None, None, seen.poses)
    assert ours.learnt.poses is None
    assert ours.summary.doubts == HarmonicMap.fit(seen.points, seen.field, NO_SEARCH).summary.doubts


def test_errors_of_sensors_are_no_errors_of_poses(world: DipoleWorld) -> None:
    """Two sensors, each on every other lane, are off by H: poses explain nothing of it.

    The tile holds what H did to all of its readings, and a view has only those in its middle.
    """
    seen = survey(world, 0.0)
    options = NO_SEARCH.model_copy(update={"hyperparameters": GIVEN})
    learnt = HarmonicMap.fit(seen.points, seen.field, options).learnt
    owner, weight = cubes_of(seen.points, options.merge), np.ones(len(seen.points))
    index = int(np.argmax([len(rows) for rows in learnt.members]))
    assert len(learnt.members[index]) > 1.5 * MOST_READINGS
    shift = np.zeros((len(owner), SHIFT, SIZE))
    shift[:, 3:, 12:15] = np.eye(3)
    covariance = np.diag(np.tile(np.where(shift[0].any(axis=0), 10.0**2, 0.0), 2))
    sensor, every = seen.poses.drive % 2, np.arange(len(owner))
    suite = SuiteErrors(("s0", "s1"), covariance, every, sensor, shift)
    suite = suite.averaged(owner, weight)
    turns = seen.poses.shift.copy()
    turns[:, :3] = 0.0
    poses = replace(seen.poses, shift=turns).averaged(owner, weight)
    rows = np.arange(len(learnt.readings))
    effect = suite.of_field(rows, np.zeros((len(rows), 3, 3)))
    off = effect @ np.repeat([1.0, -1.0], SIZE)

    def pull(field: FloatArray) -> FloatArray:
        read = replace(learnt, readings=replace(learnt.readings, field=field), suite=suite)
        view = pose_view(read, Tiles(read), poses, index)
        system = view.among(np.array([0, 1])).system  # tilt and heading
        return np.asarray(system.pull / np.sqrt(np.diag(system.information)))

    moved = pull(learnt.readings.field + off) - pull(learnt.readings.field)
    assert np.abs(moved).max() < 0.05


@pytest.mark.parametrize("tilt", [TILT, 0.0])
def test_stated_errors_without_a_duration_count_if_readings_of_a_pass_have_them(
    world: DipoleWorld, tilt: float
) -> None:
    """Where passes have nothing in common they are noise of each reading, which is learnt."""
    seen = survey(world, tilt)
    units = seen.poses.shift * np.array([TILT, TILT, 0, 0, 0, 0])
    told = replace(seen.poses, shift=units, stated=True, duration_stated=False)
    ours = HarmonicMap.fit(seen.points, seen.field, NO_SEARCH, None, None, told)
    assert ours.poses_uncertain == (tilt > 0)
    assert told.like(None) is None
    assert told.like(seen.poses) is told


@given(seed=st.integers(0, 1000), count=st.integers(1, 8))
def test_no_part_has_more_than_the_whole(seed: int, count: int) -> None:
    root = np.random.default_rng(seed).normal(size=(count, count))
    part = root @ root.T
    least = within_whole(part)
    assert np.linalg.eigvalsh(least @ part @ least.T).max() <= 1.0
    small = part / (2 * np.linalg.eigvalsh(part).max())
    np.testing.assert_allclose(within_whole(small), np.eye(count), atol=1e-12)


def test_tiles_that_a_pass_goes_through_share_its_errors_though_no_reading() -> None:
    poses = replace(errors(4), drive=np.zeros(4, dtype=np.int64))
    poses = replace(poses, seconds=np.array([0.0, 5.0, 6.0, 200.0]), lasting_s=1.0)
    members = [np.array([0]), np.array([1, 2]), np.array([3])]
    assert shared_poses(members, poses) == [(1, 0)]
    alone = replace(poses, drive=np.array([0, 1, 1, 1]))
    assert shared_poses(members, alone) == []


def test_a_map_s_errors_are_its_variance_also_between_tiles(
    world: DipoleWorld, exact: HarmonicMap
) -> None:
    """The covariance of errors over a drive is one, and its diagonal that of the map."""
    seen = survey(world, TILT)
    stated = replace(seen.poses, sizes=np.array([TILT, TILT, 0, 0.002, 0.002, 0]))
    ours = HarmonicMap.condition(replace(exact.learnt, poses=stated), NO_SEARCH)
    at = np.column_stack([np.random.default_rng(7).uniform(0.3, SIDE - 0.3, (60, 2)), np.zeros(60)])
    covariance = ours.covariance(at).reshape(180, 180)
    np.testing.assert_allclose(covariance.diagonal(), ours.variance(at).ravel(), rtol=1e-6)
    assert len(ours.errors_over(at).sizes()) > 1
    assert np.linalg.eigvalsh(ours.errors_over(at).covariance).min() > 0


@pytest.fixture(scope="module")
def posed(world: DipoleWorld) -> HarmonicMap:
    seen = survey(world, TILT)
    few = np.arange(0, len(seen.points), 3)
    poses = replace(seen.poses, shift=seen.poses.shift * 0.01, stated=True)
    poses = SurveyPoses(
        np.arange(len(few)), poses.drive[few], poses.seconds[few], poses.shift[few], 2.0, True
    )
    return HarmonicMap.fit(seen.points[few], seen.field[few], NO_SEARCH, None, None, poses)


def test_a_map_keeps_the_errors_of_its_poses(posed: HarmonicMap) -> None:
    again = map_from_state(posed.to_state())
    at = posed.readings.points[::20] + 0.05
    one, other = posed.query(at), again.query(at)
    np.testing.assert_allclose(one.field, other.field, atol=1e-4)  # kept with seven digits
    np.testing.assert_allclose(one.variance, other.variance, rtol=1e-4)
    exact = HarmonicMap.condition(replace(posed.learnt, poses=None), NO_SEARCH).query(at)
    # A tilt turns a vertical field into the level.
    assert (one.variance[:, :2] > 2 * exact.variance[:, :2]).all()


def test_more_readings_keep_the_errors_of_the_old_ones(posed: HarmonicMap) -> None:
    points, field = posed.readings.points[:40] + np.array([0, 0.3, 0]), posed.readings.field[:40]
    silent = posed.updated(points, field)
    assert silent.learnt.poses is not None
    assert silent.learnt.poses.reading.max() < len(silent.learnt.readings)
    assert posed.learnt.poses is not None
    first = replace(errors(40), shift=1e-3 * errors(40).shift)
    more = posed.updated(points, field, None, first).learnt.poses
    assert more is not None
    assert len(more.reading) == len(posed.learnt.poses.reading) + 40
    # Nothing is said of these: those of a map whose poses were stated count as exact.
    unknown = posed.updated(points, field, None, replace(first, stated=False)).learnt.poses
    assert unknown is not None
    assert len(unknown.reading) == len(posed.learnt.poses.reading)


def test_a_map_that_is_kept_up_counts_the_errors_of_new_poses(posed: HarmonicMap) -> None:
    learnt = posed.learnt
    history = History.of_survey(len(learnt.readings), UNDATED)
    kept = HarmonicMap.condition(replace(learnt, history=history), NO_SEARCH)
    points, field = posed.readings.points[:40] + np.array([0, 0.3, 0]), posed.readings.field[:40]
    first = replace(errors(40), shift=1e-3 * errors(40).shift)
    more = kept.updated(points, field, None, first).learnt.poses
    assert learnt.poses is not None
    assert more is not None
    assert len(more.reading) == len(learnt.poses.reading) + 40
    # Readings of two drives stay apart: the new ones are numbered after all of the old ones.
    assert more.reading[-40:].min() == len(learnt.readings)


def test_readings_with_exact_poses_may_be_where_no_others_are(posed: HarmonicMap) -> None:
    away = np.array([20.0, 0.0, 0.0])  # in tiles of their own
    points, field = posed.readings.points[:40] + away, posed.readings.field[:40]
    found = posed.updated(points, field).query(points)
    assert found.inside.all()
    assert rms(found.field - field) < 2 * TILT * float(
        np.linalg.norm(EARTH)
    )  # these are tilted, too


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("pose_pairs", lambda a: a[0]),
        ("pose_pairs", lambda a: a - 10),
        ("pose_pairs", lambda a: a + 10**6),
        ("pose_seconds", lambda a: a[1:]),
        ("pose_seconds", lambda a: a * np.nan),
        ("pose_shift", lambda a: a + np.inf),
        ("pose_lasting", lambda a: 0 * a),
        ("pose_stated", lambda a: np.append(a, 1)),
        ("pose_sizes", lambda a: -a),
    ],
)
def test_damaged_poses_are_refused_in_one_line(
    posed: HarmonicMap, name: str, change: Callable[[FloatArray], FloatArray]
) -> None:
    state = posed.to_state()
    damaged = replace(state, arrays={**state.arrays, name: change(state.arrays[name])})
    with pytest.raises(MapError, match="map poses are damaged") as raised:
        map_from_state(damaged)
    assert "\n" not in str(raised.value)
