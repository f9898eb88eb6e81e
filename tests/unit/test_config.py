"""Configuration: defaults, unknown keys, wrong values."""

from pathlib import Path

import pytest

from l2m_gtsam.calibration.optimise import Optimizer
from l2m_gtsam.config import Config, load_config
from l2m_gtsam.errors import ConfigError


def test_defaults_without_a_file() -> None:
    assert load_config(None) == Config()


def test_an_empty_file_is_all_defaults(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("# nothing\n")
    assert load_config(path) == Config()


def test_values_are_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("calibration: {solve: {optimizer: gn}, start: {m: [0.1, 0, 0]}}\n")
    config = load_config(path)
    assert config.calibration.solve.optimizer is Optimizer.GN
    assert config.calibration.start == {"m": (0.1, 0.0, 0.0)}


def test_the_effective_configuration_reads_back() -> None:
    config = Config()
    assert Config.model_validate(config.model_dump(mode="json")) == config


@pytest.mark.parametrize(
    ("content", "pattern"),
    [
        (
            "calibration: {solve: {optimiser: gn}}",
            r"unknown key 'calibration.solve.optimiser'; accepted here: .*optimizer",
        ),
        (
            "colour: red",
            r"unknown key 'colour'; accepted here: bag, calibration, fleet, lidar, mapping",
        ),
        ("bag: {fields: 7}", r"bag.fields: a list is expected, got 7"),
        ("calibration: {solve: {optimizer: newton}}", r"calibration.solve.optimizer: .*'lm' or"),
        ("calibration: {sync: {max_pose_gap_s: soon}}", r"max_pose_gap_s: .*number.*'soon'"),
        ("[1, 2]", r"the file: "),
        (
            "bag: {regressors: {motor: {topic: /m, feild: x}}}",
            r"unknown key 'bag.regressors.motor.feild'; accepted here: field, scale, topic",
        ),
        (
            "qa: {position_sigma_m: {wran: 0.003}}",
            r"unknown key 'qa.position_sigma_m.wran'; accepted here: fail, warn",
        ),
        ("bag: {fields: [", r"not valid YAML"),
        ("bag:\n\tfields: []", r"not valid YAML, line 2: found character '\\t'"),
    ],
)
def test_faults_are_one_line_that_names_the_key(tmp_path: Path, content: str, pattern: str) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(content)
    with pytest.raises(ConfigError, match=pattern) as error:
        load_config(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_the_example_of_moving_distortion_loads(repository: Path, tmp_path: Path) -> None:
    page = (repository / "docs" / "moving-distortion.md").read_text()
    path = tmp_path / "c.yaml"
    path.write_text(page.split("```yaml\n")[1].split("```")[0])
    regressors = load_config(path).bag.regressors
    assert regressors["left_wheel"].scale == 0.01
    assert regressors["turning"].field == "twist.twist.angular.z"


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere.yaml: no such file"):
        load_config(tmp_path / "nowhere.yaml")
