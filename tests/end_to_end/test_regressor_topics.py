"""`l2m calibrate` with a motor's current in the bag."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.records.sensor_models import Model
from l2m_gtsam.storage.calibration_file import read_calibration
from tests.drives.bags import Entry, ros, write
from tests.support.command_line import complaint_here, l2m
from tests.worlds.yard import NOISE, START, STEP, Yard, route, world

pytestmark = pytest.mark.usefixtures("without_pages")

H = np.array([0.8, -0.5, 0.6])  # uT/A


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive through the west, turning and tilting, whose motor's current swings by 2 A."""
    make, entries = ros("mcap"), []
    p, rng = route(-2.8, 0.2), np.random.default_rng(5)
    k = np.arange(len(p))
    angles = np.column_stack([0.05 * k, 0.2 * np.sin(0.31 * k), 0.2 * np.cos(0.43 * k)])
    R = Rotation.from_euler("ZYX", angles)
    amperes = 4 + 2 * np.sin(0.07 * k) + rng.normal(0, 0.3, len(k))
    field, _ = world().field_and_gradient(p)
    field = R.inv().apply(field) + np.outer(amperes, H) + rng.normal(0, NOISE, field.shape)
    for n, q in enumerate(R.as_quat()):
        stamp = START + n * STEP
        messages = {
            "/pose": ("geometry_msgs/PoseStamped", make.pose_stamped(stamp, p[n], q)),
            "/mag": ("sensor_msgs/MagneticField", make.magnetic(stamp, field[n] * 1e-6)),
            "/motor": ("std_msgs/Float64", make("std_msgs/Float64", data=amperes[n])),
            "/fan": ("std_msgs/Float64", make("std_msgs/Float64", data=1.5)),
            "/warmth": (
                "sensor_msgs/Temperature",
                make(
                    "sensor_msgs/Temperature",
                    header=make.header(stamp, "mag"),
                    temperature=24.5,
                    variance=0.01,
                ),
            ),
        }
        entries += [Entry(topic, kind, stamp, each) for topic, (kind, each) in messages.items()]
    return write(tmp_path_factory.mktemp("regressors"), "mcap", entries, "drive")


def configured(folder: Path, yard: Yard, regressors: dict[str, Any]) -> Path:
    """Write the yard's configuration with these numbers; JSON is YAML."""
    content = json.loads(yard.config.read_text())
    content["bag"]["regressors"] = regressors
    content["calibration"] = {"start": {"mag": [0, 0, 0]}}
    path = folder / "c.yaml"
    path.write_text(json.dumps(content))
    return path


def test_a_current_is_read_and_told(
    yard: Yard, field_map: Path, drive: Path, tmp_path: Path
) -> None:
    config = configured(tmp_path, yard, {"motor": {"topic": "/motor", "scale": 1000}})
    arguments = ("--map", field_map, "--config", config, "--out", tmp_path / "out", "--models")
    out = " ".join(l2m("calibrate", drive, *arguments).out.split())
    assert "Models of mag, motor: " in out
    assert "model of mag: full + regressors" in out
    assert "motor: 0.000" in out
    sensor = read_calibration(tmp_path / "out" / "calibration.yaml")["mag"]
    assert sensor.models is not None
    assert sensor.models.recommended.has_regressors
    (motor,) = sensor.moving
    # Per thousandth of the unit; the map's own errors are of the size of the noise.
    np.testing.assert_allclose(1000 * motor.h, H, atol=0.05)


def test_without_asking_nothing_is_shown_of_models(
    yard: Yard, field_map: Path, tmp_path: Path
) -> None:
    config = configured(tmp_path, yard, {})
    arguments = ("--map", field_map, "--config", config, "--out", tmp_path / "out")
    out = l2m("calibrate", yard.west, *arguments).out
    assert "Models of" not in out
    sensor = read_calibration(tmp_path / "out" / "calibration.yaml")["mag"]
    assert sensor.moving == ()
    assert sensor.models is not None
    assert Model.REGRESSORS not in [fit.model for fit in sensor.models.fits]
    assert ("model of mag: " in out) == (sensor.models.recommended is not Model.FULL)


@pytest.mark.parametrize(
    ("regressors", "expected"),
    [
        ({"motor": {"topic": "/engine"}}, "regressor 'motor': no topic '/engine'; there are: "),
        ({"fan": {"topic": "/fan"}}, "regressor 'fan': it is 1.5 at all readings"),
        (
            {"warmth": {"topic": "/warmth", "field": "temperature"}},
            "regressor 'warmth': it is 24.5 at all readings",
        ),
        ({"motor": {"topic": "/motor", "feild": "data"}}, "accepted here: field, scale, topic"),
        ({"motor": {"topic": "/motor", "field": "a b"}}, "bag.regressors.motor.field: "),
        ({"1": {"topic": "/motor"}}, "bag.regressors.1"),
    ],
)
def test_bad_input(
    yard: Yard,
    field_map: Path,
    drive: Path,
    tmp_path: Path,
    regressors: dict[str, Any],
    expected: str,
) -> None:
    config = configured(tmp_path, yard, regressors)
    out = tmp_path / "out"
    assert expected in complaint_here(
        "calibrate", drive, "--map", field_map, "--config", config, "--out", out
    )
    assert not out.exists()
