"""Files that an earlier version wrote of simulated drives: still read, and written the same."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from ruamel.yaml import YAML

from l2m_gtsam.maps.build import map_from_state
from l2m_gtsam.qa.options import Limit, QaOptions
from l2m_gtsam.records.calibration import Return, SensorStatus, Uncertainty
from l2m_gtsam.records.localisation import LocalisationStatus
from l2m_gtsam.records.sensor_models import Model
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from l2m_gtsam.storage.map_file import load_map, save_map
from l2m_gtsam.storage.record_files import read_metrics, read_slam, write_metrics, write_slam

FILES = Path(__file__).parents[2] / "files"


def without(path: Path, explanation: str) -> list[tuple[str, Any]]:
    """Return what a file holds, in its order, but for the words in which it explains itself."""
    text = path.read_text(encoding="utf-8")
    content = json.loads(text) if path.suffix == ".json" else YAML(typ="safe", pure=True).load(text)
    assert content.pop(explanation)
    content.pop("id", None)  # which no file of an earlier version carries
    return flat(content)


def flat(content: Any, key: str = "") -> list[tuple[str, Any]]:
    """Return each value with the keys that lead to it, in order; a number as it is written."""
    if isinstance(content, dict):
        return [(key, "{")] + [e for k, v in content.items() for e in flat(v, f"{key}/{k}")]
    if isinstance(content, list):
        return [(key, "[")] + [e for v in content for e in flat(v, f"{key}/")]
    return [(key, repr(content))]


def test_calibration() -> None:
    """One sensor in a corridor; digits as the file has them."""
    result = read_calibration(FILES / "calibration.yaml")
    assert (result.iterations, result.uncertainty) == (1, Uncertainty.FULL)
    assert len(result.doubts) == 2
    assert (result.disagreements, result.notes, result.bags) == ((), (), ())
    assert result.bag is not None
    assert result.bag.sha256.startswith("01354a3e")
    assert result.options["calibration"]["solve"]["graph_iterations"] == 2
    (sensor,) = result.sensors
    assert (sensor.sensor, sensor.status) == ("mag_00", SensorStatus.SOLVED)
    assert sensor.message == "converged on 192 readings"
    # Copied from the file: as many digits as it has there.
    assert sensor.t_lidar_mag[2] == pytest.approx(-0.107164691, abs=1e-9)
    assert sensor.distortion.C[1, 0] == pytest.approx(-0.07136238, abs=1e-8)
    assert sensor.distortion.H[1] == pytest.approx(-4.76128055, abs=1e-8)
    assert sensor.R_lidar_mag[2, 0] == pytest.approx(0.05564821, abs=1e-8)
    assert sensor.covariance[8, 13] == -0.0004159838958764508
    assert sensor.t_sigma[0] == pytest.approx(2.9331235e-3, abs=1e-9)
    assert sensor.rotation_covariance[0, 2] == pytest.approx(-1.21205965e-6, abs=1e-13)
    assert sensor.noise == 0.1032831598427237
    assert (sensor.sync.received, sensor.sync.thinned, sensor.sync.kept) == (200, 6, 192)
    assert sensor.residuals is not None
    assert sensor.residuals.chi2_per_dof == 1.0014997350779096
    assert sensor.residuals.rms_axes[1] == pytest.approx(0.09845056, abs=1e-8)
    assert sensor.start is not None
    assert sensor.start.margin == 2.5667107344498215
    assert sensor.start.runner_up is not None
    assert sensor.start.runner_up.tolist() == [0.5, 1.0, 0.0]
    assert sensor.time_offset is not None
    assert sensor.time_offset.estimated
    assert sensor.time_offset.seconds == -0.0008651588955758922
    assert sensor.time_offset.cross_covariance[14] == pytest.approx(4.7606132e-6, abs=1e-13)
    assert sensor.models is not None
    assert sensor.models.recommended is Model.FULL
    assert sensor.models[Model.SCALE].bic == 1714.1399022643532
    assert sensor.models.coefficients.C[2, 2] == 1.0311781348730498
    assert sensor.models.coefficients.h.shape == (0, 3)
    assert sensor.models.sigma.H[0] == 0.03503844675607516


def test_calibration_with_all_that_may_be_in_it() -> None:
    """Two drives, made-up numbers: models with motors, disagreements, sensors without a result."""
    result = read_calibration(FILES / "calibration_of_two_drives.yaml")
    assert (result.bag, [each.path for each in result.bags]) == (
        None,
        ["drives/first.mcap", "drives/second.mcap"],
    )
    assert (result.doubts, result.notes) == (("doubt",), ("a note",))
    first, second = result.disagreements
    assert (first.bag, second.bag) == ("", "drives/second.mcap")
    assert (first.passed_again, second.passed_again) == (Return.DIFFERS, Return.NEVER)
    assert first.p_to.tolist() == [1.5, 2.0, 0.5]
    assert second.sensors == ("front left", "top")
    assert first.end_ns == 1700000005000000003
    left = result["front left"]
    assert left.status is SensorStatus.CONTRADICTED
    assert left.missing_in == ("drives/second.mcap",)
    assert (left.from_priors, left.rejected) == (("t_z: planar",), 12)
    assert left.start is not None
    assert (left.start.margin, left.start.runner_up) == (np.inf, None)
    assert left.time_offset is not None
    assert (left.time_offset.held, left.time_offset.sigma) == ("the field hardly changes", np.inf)
    assert [each.name for each in left.moving] == ["motor", "speed of wheel"]
    assert left.moving[1].h.tolist() == [0.001, 0.002, -0.003]
    assert left.moving[1].sigma.tolist() == [np.inf, 0.0001, 0.0002]
    assert left.models is not None
    assert left.models.regressors == ("motor", "speed of wheel")
    assert left.models.coefficients.h.tolist() == [[0.5, -0.25, 0.125], [0.001, 0.002, -0.003]]
    assert np.isinf(left.models.sigma.E).all()
    assert left.sync.without_regressor == 6
    rear = result["rear"]
    assert (rear.status, rear.not_compared) == (SensorStatus.NO_READINGS, "no readings")
    assert np.isnan(rear.distortion.C).all()
    assert np.isnan(rear.noise)
    assert (rear.residuals, rear.start, rear.time_offset, rear.models) == (None, None, None, None)
    top = result["top"]
    assert top.covariance[2, 2] == np.inf
    assert top.start is not None
    assert top.start.runner_up is not None
    assert top.start.runner_up.tolist() == [0.1, 0.2, 0.3]


def test_metrics() -> None:
    """Figures of the same calibration."""
    metrics = read_metrics(FILES / "metrics.json")
    assert metrics.bags is None
    assert metrics.drive.length == 27.51098695782291
    assert metrics.map.extent == (0.824, 9.177, 0.025, 3.784)
    sensor = metrics.get("mag_00")
    assert sensor is not None
    assert sensor.mounting.scale == (0.994522, 0.985221, 1.033076)
    assert sensor.mounting.axes.along == ("+x", "+y", "+z")
    assert sensor.fit.map_noise == 0.03724377387910969
    assert sensor.normalised.counts[:3] == (31, 30, 23)
    assert sensor.autocorrelation.independent == 158.040692333403
    assert sensor.directions.spread == (34.8612, 21.6316, 1.4974)
    assert sensor.curves.before == 118.71412435817719
    assert sensor.halves.distance == 0.5633461493556202
    assert sensor.series.place[3] == (2.73, 1.4, 0.69)
    assert sensor.drives is None


def test_localisation() -> None:
    """A short drive of another vehicle without a map."""
    record = read_slam(FILES / "slam.json")
    assert record.status is LocalisationStatus.LOCALISED
    assert record.drift.end_m == 0.03714371659220385
    assert record.steps == 0.009698210320241157
    assert (record.scale, record.start, record.truth, record.scans) == (None, None, None, None)
    assert record.explored is not None
    assert record.explored.tiles == 2
    assert record.sensors[0].use.readings == 33
    assert record.sensors[0].use.chi2_per_dof == 0.18526823724523625
    assert len(record.poses) == len(record.odometry) == 35
    pose = record.poses[20]
    assert pose.stamp_ns == 1748772009284162624
    assert pose.p == (3.658783436056833, 2.564381053762167, 0.8468782243613604)
    assert pose.covariance is not None
    assert pose.covariance[3][4] == 0.0015764494036746126
    assert record.odometry[20].sigma[0] == 0.146431427
    assert [each.role for each in record.sources] == ["drive", "calibration"]


def test_map() -> None:
    """The map that it was calibrated in: what it holds, and the field that it gives."""
    state = load_map(FILES / "map.npz")
    assert state.kind == "harmonic"
    assert state.provenance["readings"] == 388
    assert state.arrays["points"].shape == (361, 3)
    field_map = map_from_state(state)
    sample = field_map.query(np.array([[2.8, 1.6, 0.3], [3.5, 3.0, 0.8]]))
    # Digits that it had when it was made; processors differ in the last ones.
    field = [[1.71457768, 39.53440881, 6.45788745], [1.50414395, 38.29281737, 6.69186191]]
    np.testing.assert_allclose(sample.field, field, rtol=1e-6)
    np.testing.assert_allclose(
        sample.gradient[1, 2], [-0.67353006, 0.04748102, -0.24584353], rtol=1e-6
    )
    np.testing.assert_allclose(sample.variance[1], [0.0012852, 0.00178122, 0.00314291], rtol=1e-5)


@pytest.mark.parametrize("name", ["calibration.yaml", "calibration_of_two_drives.yaml"])
def test_a_calibration_is_written_the_same(name: str, tmp_path: Path) -> None:
    """The same keys in the same order with the same digits: other programs read these files."""
    write_calibration(tmp_path / name, read_calibration(FILES / name))
    assert without(tmp_path / name, "model") == without(FILES / name, "model")


def test_other_files_are_written_the_same(tmp_path: Path) -> None:
    write_slam(tmp_path / "slam.json", read_slam(FILES / "slam.json"))
    assert without(tmp_path / "slam.json", "legend") == without(FILES / "slam.json", "legend")
    write_metrics(tmp_path / "metrics.json", read_metrics(FILES / "metrics.json"))
    save_map(tmp_path / "map.npz", load_map(FILES / "map.npz"))
    for name in ("metrics.json", "map.npz"):
        assert (tmp_path / name).read_bytes() == (FILES / name).read_bytes()


def test_the_former_limit_of_halves_is_understood() -> None:
    assert QaOptions.model_validate({"halves_sigmas": {"warn": 3.0, "fail": 6.0}}) == QaOptions(
        halves_apart=Limit(warn=1.5, fail=3.0)
    )
    with pytest.raises(ValidationError, match="halves_apart"):
        QaOptions.model_validate({"halves_sigmas": {"warn": 3.0, "fail": "much"}})
