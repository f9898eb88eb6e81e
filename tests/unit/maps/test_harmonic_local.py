"""Scales and depths of one tile about those of the map."""

import numpy as np
import pytest
from scipy.optimize import minimize

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.evidence import evidence, normal_of
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.harmonic.local import NAMES, LocalOptions, local_hyperparameters
from l2m_gtsam.maps.training import TrainingSet, training_set
from tests.worlds.exact import DipoleWorld
from tests.worlds.harmonic import GIVEN, NO_SEARCH, TILTED, basis, places

WANTED = LocalOptions(spread=0.7, steps=8)


def survey(truth: Hyperparameters, seed: int, count: int = 150) -> TrainingSet:
    """Return readings drawn from the prior of ``basis`` with these hyperparameters."""
    rng, model = np.random.default_rng(seed), basis()
    points = places(count, seed) @ TILTED.T + model.frame.corner
    w = np.exp(0.5 * model.prior(truth).log_variance) * rng.normal(size=len(model))
    noise = rng.normal(0, truth.noise, (count, 3))
    return training_set(points, model.features(points) @ w + noise)


def logs(hyperparameters: Hyperparameters) -> FloatArray:
    return np.log([getattr(hyperparameters, name) for name in NAMES])


def changed(by: float) -> Hyperparameters:
    """Return GIVEN with all scales and depths times a factor."""
    return GIVEN.model_copy(update={name: by * getattr(GIVEN, name) for name in NAMES})


def reference(readings: TrainingSet) -> FloatArray:
    """Return where a general search finds the largest of likelihood times prior."""
    normal = normal_of(basis(), readings)

    def cost(x: FloatArray) -> float:
        update = dict(zip(NAMES, np.exp(x).tolist(), strict=True))
        trial = GIVEN.model_copy(update=update)
        found = evidence(normal, basis().prior(trial).log_variance, GIVEN.noise).value
        return float(0.5 * np.sum(((x - logs(GIVEN)) / WANTED.spread) ** 2)) - found

    end = minimize(cost, logs(GIVEN), method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-5})
    return np.asarray(end.x)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_scoring_ends_where_the_likelihood_is_largest(factor: float, seed: int) -> None:
    """Within a seventh: a scale or depth of one tile is known to a tenth at best.

    The reference moves the prior of all waves, ours that of waves which tell something.
    """
    readings = survey(changed(factor), seed)
    ours = local_hyperparameters(basis(), normal_of(basis(), readings), GIVEN, WANTED)
    np.testing.assert_allclose(logs(ours), reference(readings), atol=0.15)
    assert (ours.noise, ours.structure_scale) == (GIVEN.noise, GIVEN.structure_scale)


def test_no_spread_shares_the_maps() -> None:
    normal = normal_of(basis(), survey(changed(2.0), 0))
    assert local_hyperparameters(basis(), normal, GIVEN, LocalOptions(spread=0)) == GIVEN


def test_given_hyperparameters_are_those_of_every_tile() -> None:
    points, field = quiet_and_strong()
    options = HarmonicOptions(hyperparameters=GIVEN, search=NO_SEARCH, modes=200, mode_share=0.5)
    ours = HarmonicMap.fit(points, field, options)
    assert len(ours.tiles) > 1
    assert all(tile.hyperparameters == GIVEN for tile in ours.tiles)


def quiet_and_strong() -> tuple[FloatArray, FloatArray]:
    """Return a survey of a hall, 12 m long, with steel under one half of its floor alone."""
    rng = np.random.default_rng(0)
    points = rng.uniform([0, 0, 0.2], [12, 3, 0.8], (3000, 3))
    sources = rng.uniform([7, -1, -0.6], [13, 4, -0.4], (80, 3))
    world = DipoleWorld(np.array([20.0, 0.0, -40.0]), sources, rng.normal(0, 1, (80, 3)))
    return points, world.field_and_gradient(points)[0] + rng.normal(0, 0.1, points.shape)


def test_a_quiet_half_of_a_hall_is_known_better() -> None:
    """One scale for both claims too much error where it is quiet, too little where it is not."""
    points, field = quiet_and_strong()
    learning = {"windows": 2, "modes": 200}
    told = {"search": {"rounds": 0}, "modes": 150, "learning": learning}
    ours, shared = (
        HarmonicMap.fit(points, field, HarmonicOptions.model_validate({**told, "local": local}))
        for local in ({}, {"spread": 0})
    )
    scales = np.array([tile.hyperparameters.floor_scale for tile in ours.tiles])
    east = ours.learnt.tiling.grid.centres[:, 0]
    assert np.median(scales[east > 8]) > 3 * np.median(scales[east < 4])
    at = np.array([[3.0, 1.5, 1.3], [10.0, 1.5, 1.3]])  # half a metre over what was surveyed
    (quiet, strong), (quiet_shared, strong_shared) = (
        np.sqrt(each.variance(at)[:, 2]) for each in (ours, shared)
    )
    assert quiet < 0.9 * quiet_shared
    assert strong > strong_shared
