"""`l2m config`: all options as a file that can be read, and one to start from for a log."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel
from ruamel.yaml import YAML

from l2m_gtsam.batch.options_text import inside_of, options_text, pages
from l2m_gtsam.config import Config, load_config
from l2m_gtsam.options import meanings
from l2m_gtsam.storage.inspect import inspect_bag
from tests.drives.bags import Entry, ros, write
from tests.support.command_line import complaint_here, ended, l2m
from tests.support.repository import REPOSITORY

START = 1_700_000_000_000_000_000


def test_all_options_are_a_configuration_of_defaults(tmp_path: Path) -> None:
    text = l2m("config").out
    (tmp_path / "all.yaml").write_text(text)
    assert load_config(tmp_path / "all.yaml") == Config()
    part = l2m("config", "calibration.solve").out
    content = YAML(typ="safe", pure=True).load(part)
    assert list(content) == ["calibration"]
    assert list(content["calibration"]) == ["solve"]
    told = complaint_here("config", "calibration.speed")
    assert "no option 'speed'; there are: sync, " in told


def described(model: type[BaseModel]) -> list[str]:
    """The first words of the sentence of every option."""
    found = []
    for name, field in model.model_fields.items():
        found.append(" ".join(meanings(model)[name].split()[:3]))
        if inner := inside_of(field.annotation):
            found += described(inner.model)
    return found


def test_every_option_has_its_sentence() -> None:
    text = options_text()
    sentences = described(Config)
    assert len(sentences) > 200
    assert all(sentences)
    plain = " ".join(text.replace("#", " ").split())
    missing = [each for each in sentences if each.replace("`", "") not in plain.replace("`", "")]
    assert not missing


def test_the_pages_of_options_are_those_of_the_models() -> None:
    """If not: `make reference` writes them again."""
    for path, text in pages().items():
        assert (REPOSITORY / "docs" / path).read_text(encoding="utf-8") == text, path


@pytest.mark.parametrize(("scale", "line"), [(1e-6, None), (0.01, "gauss"), (1 / 0.0578, "number")])
def test_a_configuration_to_start_from(tmp_path: Path, scale: float, line: str | None) -> None:
    """It is read again, and the log can be calibrated with it."""
    make, entries = ros("mcap"), []
    for k in range(40):
        stamp = START + k * 100_000_000
        field = scale * (np.array([20, 5, -40]) + 5 * np.sin([k, 2 * k, 3 * k]))
        if line == "number":
            field = np.round(field)
        reading = make.magnetic(stamp, field)
        entries.append(Entry("/mag", "sensor_msgs/MagneticField", stamp, reading))
        for topic in ("/slam", "/wheels"):
            pose = make.pose_stamped(stamp, [0.1 * k, 0, 0], [0, 0, 0, 1])
            entries.append(Entry(topic, "geometry_msgs/PoseStamped", stamp, pose))
    bag = write(tmp_path, "mcap", entries)
    assert ended("inspect", bag).code == 1  # which poses?
    (tmp_path / "start.yaml").write_text(l2m("config", "--for", bag).out)
    config = load_config(tmp_path / "start.yaml")
    assert config.bag.poses == "/slam"
    assert inspect_bag(bag, config.bag).obstacles == ()
    assert l2m("inspect", bag, "--config", tmp_path / "start.yaml").code == 0
    if line == "number":
        # It only makes the field of the Earth of the counts: within its variation.
        assert config.bag.units == pytest.approx(0.0578, rel=0.3)
    else:
        assert config.bag.units == (line or "auto")
    assert '# poses: "/wheels"' in (tmp_path / "start.yaml").read_text()


def test_a_configuration_names_the_poses(tmp_path: Path) -> None:
    """Those that are taken if nothing is said, and the other candidates as comments."""
    make, entries = ros("mcap"), []
    for k in range(40):
        stamp = START + k * 100_000_000
        field = 1e-6 * (np.array([20, 5, -40]) + 5 * np.sin([k, 2 * k, 3 * k]))
        place = ([0.1 * k, 0, 0], [0, 0, 0, 1])
        one = make.pose_stamped(stamp, *place)
        other = make.transform(stamp, "map", "lidar", *place)
        entries += [
            Entry("/mag", "sensor_msgs/MagneticField", stamp, make.magnetic(stamp, field)),
            Entry("/slam", "geometry_msgs/PoseStamped", stamp, one),
            Entry("/mocap", "geometry_msgs/TransformStamped", stamp, other),
        ]
    bag = write(tmp_path, "mcap", entries)
    text = l2m("config", "--for", bag).out
    assert '  poses: "/slam"  # geometry_msgs/msg/PoseStamped, 10 Hz\n' in text
    assert '  # poses: "/mocap"  # geometry_msgs/msg/TransformStamped, 10 Hz\n' in text
    (tmp_path / "start.yaml").write_text(text)
    assert load_config(tmp_path / "start.yaml").bag.poses == "/slam"


def test_what_is_missing_is_a_comment(tmp_path: Path) -> None:
    make = ros("mcap")
    entries = [
        Entry("/tf", "tf2_msgs/TFMessage", s, make("tf2_msgs/TFMessage", transforms=[link]))
        for s in range(START, START + 10**10, 10**9)
        for link in (
            make.transform(s, "map", "odom", [0, 0, 0], [0, 0, 0, 1]),
            make.transform(s, "odom", "base_link", [1e-9 * (s - START), 0, 0], [0, 0, 0, 1]),
        )
    ]
    bag = write(tmp_path, "mcap", entries)
    text = l2m("config", "--for", bag).out
    assert 'tf: {frame: "map", child_frame: "base_link"}' in text
    assert "# Cannot be calibrated as it is: " in text
    assert "no topic of a magnetometer" in text
    assert "--for: makes a whole" in complaint_here("config", "bag", "--for", bag)
