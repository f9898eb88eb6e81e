"""The search for hyperparameters, and where it starts again."""

import numpy as np

from l2m_gtsam.maps.harmonic.evidence import normal_of
from l2m_gtsam.maps.harmonic.learning import Window, likelier, maximise
from l2m_gtsam.maps.training import training_set
from tests.worlds.harmonic import GIVEN, TILTED, basis, places

BEGUN = GIVEN.model_copy(update={"noise": 0.1 * GIVEN.noise})  # as far off as starts can be


def window(seed: int) -> Window:
    """Return readings drawn from the prior of ``basis``."""
    rng, model = np.random.default_rng(seed), basis()
    points = places(150, seed) @ TILTED.T + model.frame.corner
    w = np.exp(0.5 * model.prior(GIVEN).log_variance) * rng.normal(size=len(model))
    noise = rng.normal(0, GIVEN.noise, (len(points), 3))
    readings = training_set(points, model.features(points) @ w + noise)
    return Window(model, normal_of(model, readings))


def test_from_a_corner_the_search_starts_again() -> None:
    """A floor of no strength at the shallowest depth has no slope that leads back."""
    windows = [window(1)]
    gone = GIVEN.model_copy(update={"floor_scale": 1e-3, "floor_depth": 0.03})
    corner = maximise(windows, gone)
    assert corner.hyperparameters.floor_depth < 0.05
    found = likelier(windows, corner, BEGUN)
    assert not found.at_bound
    assert found.log_likelihood > corner.log_likelihood + 10


def test_the_same_maximum_stays_where_it_was_found() -> None:
    windows = [window(2)]
    end = maximise(windows, GIVEN)
    assert likelier(windows, end, BEGUN) is end
