"""The promise of the comparison of models: the truth in 95 drives of 100 (`make study`)."""

import pytest

from l2m_gtsam.records.sensor_models import Model
from l2m_gtsam.solve.model_comparison import ModelOptions, compare_models
from tests.drives.model import NOISE, Setting, drawn

SETTINGS = {
    "white": Setting(),
    "map errors of 1 s": Setting(map_error=NOISE, length=10.0),
    "map errors of 4 s": Setting(readings=800, map_error=NOISE, length=40.0),
}


@pytest.mark.study
@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize("model", list(Model))
def test_the_truth_is_recommended_in_95_drives_of_100(model: Model, setting: str) -> None:
    drives = (drawn(model, seed, SETTINGS[setting]).samples for seed in range(100))
    found = [compare_models(samples, ModelOptions()).recommended for samples in drives]
    assert found.count(model) >= 95
