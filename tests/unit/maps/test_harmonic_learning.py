"""The search for hyperparameters, and where it starts again."""

import numpy as np
import pytest

from l2m_gtsam.maps.harmonic import learning
from l2m_gtsam.maps.harmonic.evidence import normal_of
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.learning import LearningEnd, Window, maximise, maximise_again
from l2m_gtsam.maps.training import training_set
from tests.worlds.harmonic import GIVEN, TILTED, basis, places

GONE = GIVEN.model_copy(update={"floor_scale": 1e-3, "floor_depth": 0.03})


@pytest.fixture(scope="module")
def windows() -> list[Window]:
    """Readings drawn from the prior of ``basis``."""
    rng, model = np.random.default_rng(1), basis()
    points = places(150, 1) @ TILTED.T + model.frame.corner
    w = np.exp(0.5 * model.prior(GIVEN).log_variance) * rng.normal(size=len(model))
    noise = rng.normal(0, GIVEN.noise, (len(points), 3))
    return [
        Window(model, normal_of(model, training_set(points, model.features(points) @ w + noise)))
    ]


def test_a_floor_that_is_gone_does_not_come_back(windows: list[Window]) -> None:
    assert maximise(windows, GONE).hyperparameters.floor_depth < 0.05


def test_a_search_that_ran_into_a_bound_starts_again_from_more_noise(
    windows: list[Window], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first search is one whose long first steps led to where the floor is gone."""
    starts = list[Hyperparameters]()

    def search(windows: list[Window], start: Hyperparameters) -> LearningEnd:
        starts.append(start)
        if len(starts) > 1:
            return maximise(windows, start)
        found = maximise(windows, GONE)
        return LearningEnd(
            found.hyperparameters, found.log_likelihood, 150, converged=False, at_bound=("floor",)
        )

    monkeypatch.setattr(learning, "maximise", search)
    found = maximise_again(windows, GIVEN)
    assert starts[1].noise > starts[0].noise
    assert not found.at_bound
    assert found.hyperparameters.floor_depth > 0.05


def test_another_search_that_ends_no_better_does_not_count(
    windows: list[Window], monkeypatch: pytest.MonkeyPatch
) -> None:
    end = maximise(windows, GIVEN)
    on_bound = LearningEnd(
        end.hyperparameters, end.log_likelihood, 150, converged=False, at_bound=("noise",)
    )
    monkeypatch.setattr(learning, "maximise", lambda *_: on_bound)
    assert maximise_again(windows, GIVEN) is on_bound
