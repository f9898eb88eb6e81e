"""Maps that are given more readings: as if they had been given all at once."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.bilinear.bilinear_map import BilinearMap
from l2m_gtsam.maps.build import KINDS, MapOptions, build_map, map_from_state
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.harmonic.search import SearchOptions
from l2m_gtsam.maps.hyperparameters import KernelHyperparameters
from l2m_gtsam.maps.sliding_gp import SlidingGP, SlidingGPOptions
from l2m_gtsam.maps.training import additional_set
from l2m_gtsam.records.map_diary import UNDATED
from tests.worlds.exact import dipole_world
from tests.worlds.quick_maps import QUICK_HARMONIC, quick

GIVEN = KernelHyperparameters(length_scale=0.8, signal=4.0, noise=0.2)
HEIGHTS = (0.2, 0.5, 0.8)
OLD = slice(0, 500)
NEW = slice(500, None)


def readings() -> tuple[FloatArray, FloatArray]:
    """The first half west of x = 1 m, the second one east of x = -1 m."""
    rng = np.random.default_rng(4)
    points = rng.uniform([-3, -2, 0], [1, 2, 0], (1000, 3))
    points[NEW, 0] += 2
    points[:, 2] = rng.choice(HEIGHTS, len(points))
    field, _ = dipole_world(1).field_and_gradient(points)
    return points, field + rng.normal(0, GIVEN.noise, field.shape)


def queries() -> FloatArray:
    return np.random.default_rng(5).uniform([-3.5, -2.5, 0], [3.5, 2.5, 1], (300, 3))


@pytest.mark.parametrize("spacing", [0.0, 0.15])
@pytest.mark.parametrize("kind", ["sliding_gp", "dense_gp"])
def test_a_process_is_that_of_all_readings(kind: str, spacing: float) -> None:
    part = {
        "hyperparameters": GIVEN.model_dump(),
        "thinning": {"spacing": spacing, "independent": 1000},
    }
    options = MapOptions.model_validate({"kind": kind, kind: part})
    points, field = readings()
    updated = build_map(points[OLD], field[OLD], options).updated(points[NEW], field[NEW])
    at_once = build_map(points, field, options)
    one, other = updated.query(queries()), at_once.query(queries())
    np.testing.assert_array_equal(one.inside, other.inside)
    # Means of means and means, by a factor of condition 1e5: digits end near 1e-10.
    for name in ("field", "gradient", "variance"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=1e-8)
    assert updated.summary.readings == at_once.summary.readings == len(points)
    assert updated.summary.rows == at_once.summary.rows


def test_a_place_that_counts_no_more_still_follows_new_readings() -> None:
    points, field = readings()
    rest = np.tile([[5.05, 0.05, 0.05]], (1000, 1))
    options = SlidingGPOptions(hyperparameters=GIVEN)
    old = SlidingGP.fit(np.vstack([points, rest]), np.vstack([field, 0 * rest]), options)
    new = old.updated(np.vstack([points, rest]), np.vstack([field, 0 * rest + 9.0]))
    row = int(new.trained.readings.points[:, 0].argmax())
    assert new.trained.readings.weight[row] == options.thinning.independent == 10
    # What counted of the old ones, ten, against a thousand new ones; rounding of the mean.
    np.testing.assert_allclose(new.trained.readings.field[row], 9 * 1000 / 1010, rtol=1e-12)


def test_a_grid_is_that_of_all_readings() -> None:
    points, field = readings()
    updated = BilinearMap.fit(points[OLD], field[OLD]).updated(points[NEW], field[NEW])
    at_once = BilinearMap.fit(points, field)
    # Means of means and means: rounding.
    np.testing.assert_allclose(updated.readings.points, at_once.readings.points, rtol=0, atol=1e-12)
    np.testing.assert_allclose(updated.readings.field, at_once.readings.field, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(updated.readings.weight, at_once.readings.weight)
    one, other = updated.query(queries()), at_once.query(queries())
    np.testing.assert_allclose(one.field, other.field, rtol=0, atol=1e-10)
    # The old readings' squares are carried over by the averages of their cells.
    assert updated.spread == pytest.approx(at_once.spread, rel=0.02)


def test_a_harmonic_map_is_nearly_that_of_all_readings() -> None:
    """With the same prior, but the tiles and modes of the first half: within the sigma."""
    points, field = readings()
    usual_margin = QUICK_HARMONIC | {"tiling": {}, "local": {"spread": 0}}
    options = MapOptions.model_validate({"harmonic": usual_margin})
    updated = build_map(points[OLD], field[OLD], options).updated(points[NEW], field[NEW])
    prior = updated.to_state().arrays["hyperparameters"]
    names = sorted(Hyperparameters.model_fields)
    given = dict(zip(names, prior.tolist(), strict=True))
    options = MapOptions.model_validate({"harmonic": usual_margin | {"hyperparameters": given}})
    at_once = build_map(points, field, options)
    one, other = updated.query(queries()), at_once.query(queries())
    both = one.inside & other.inside
    assert both.sum() > 0.95 * max(one.inside.sum(), other.inside.sum())
    away = (one.field - other.field)[both] / np.sqrt(other.variance[both])
    # What the edges of tiles cost; 0.42 at a margin of 0.5 m.
    assert np.sqrt(np.mean(away**2)) < 0.3


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_the_new_place_is_known_and_the_file_too(kind: str) -> None:
    points, field = readings()
    old = build_map(points[OLD], field[OLD], quick(kind))
    east = np.array([[2.5, 0.0, 0.5]])
    assert not old.query(east).inside.any()
    updated = old.updated(points[NEW], field[NEW])
    assert not old.query(east).inside.any()
    assert updated.query(east).inside.all()
    assert updated.kind == kind
    assert updated.summary.readings == len(points)
    truth, _ = dipole_world(1).field_and_gradient(east)
    np.testing.assert_allclose(updated.query(east).field, truth, atol=2)  # the signal is 4 uT
    again = map_from_state(updated.to_state())
    assert again.query(east).inside.all()


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_bad_readings_are_refused(kind: str) -> None:
    points, field = readings()
    old = build_map(points[OLD], field[OLD], quick(kind))
    field[700, 1] = np.nan
    with pytest.raises(MapError, match="training reading 200 of 500 is not finite"):
        old.updated(points[NEW], field[NEW])


def test_steel_between_two_drives_is_no_doubt_where_readings_are_left_out() -> None:
    rng, options = np.random.default_rng(0), HarmonicOptions(hyperparameters=Hyperparameters())
    options = options.model_copy(update={"search": SearchOptions(rounds=0)})
    points = np.column_stack([rng.uniform(0, 2, (400, 2)), np.full(400, 0.4)])
    field = np.array([15.0, 8.0, 40.0]) + rng.normal(0, 0.1, (400, 3))
    learnt = HarmonicMap.fit(points, field, options).learnt
    steel = additional_set(points, field + np.array([0, 0, 15]))
    learnt = learnt.followed_by(steel, options, None, UNDATED)
    keep = np.arange(len(learnt.readings)) > 0
    assert learnt.only(keep, options).origin.survey == learnt.origin.survey == ()
