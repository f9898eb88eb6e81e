"""A plain list of sensors serves where a calibration does."""

from pathlib import Path

import numpy as np
import pytest

import l2m_gtsam as l2m
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.storage.calibration_file import write_calibration
from l2m_gtsam.storage.listed_sensors import read_sensors
from tests.drives.calibrations import calibration, sensor
from tests.drives.localised import OPTIONS, WORLD, driven, localised
from tests.support.records import assert_equal

LIST = """sensors:
  left: {t_lidar_mag: [0.1, 0.2, 0.3], H: [1, 2, 3], t_sigma: 0.02, C_sigma: 0.03, H_sigma: 4}
  right: {t_lidar_mag: [0.1, -0.2, 0.3], C: [[0, 1, 0], [-1, 0, 0], [0, 0, 1.1]], noise: 0.2}
"""


def test_a_list_says_how_well_sensors_are_known(tmp_path: Path) -> None:
    (tmp_path / "sensors.yaml").write_text(LIST)
    found = read_sensors(tmp_path / "sensors.yaml")
    left, right = found.sensors
    np.testing.assert_allclose(left.t_sigma, 0.02)
    np.testing.assert_allclose(left.C_sigma, 0.03)
    np.testing.assert_allclose(left.H_sigma, 4)
    # R_lidar_mag turns by 90 degrees: x of the sensor lies along y of the lidar.
    np.testing.assert_allclose(right.R_lidar_mag[:, 0], [0, 1, 0], atol=1e-12)
    assert right.noise == 0.2
    assert left.noise == 0.3
    of_sigmas, of_noise = found.notes
    assert "sigmas of right are not given" in of_sigmas
    assert "the noise of readings of left is not given" in of_noise


def test_a_list_that_says_all_has_no_notes(tmp_path: Path) -> None:
    given = "t_lidar_mag: [0, 0, 0], t_sigma: 0.02, C_sigma: 0.03, H_sigma: 4, noise: 0.2"
    (tmp_path / "sensors.yaml").write_text(f"sensors: {{a: {{{given}}}}}")
    assert read_sensors(tmp_path / "sensors.yaml").notes == ()


def test_a_calibration_is_read_as_one(tmp_path: Path) -> None:
    whole = write_calibration(tmp_path / "calibration.yaml", calibration(sensor("a")))
    assert_equal(read_sensors(tmp_path / "calibration.yaml"), whole)


def test_a_drive_is_localised_with_a_list(tmp_path: Path) -> None:
    drive, known = driven()
    lines = ["sensors:"]
    for each in known.sensors:
        C, H = each.distortion.C.tolist(), each.distortion.H.tolist()
        lines.append(f"  {each.sensor}: {{t_lidar_mag: {each.t_lidar_mag.tolist()}, C: {C},")
        lines.append(f"    H: {H}, noise: {each.noise}, t_sigma: 0.01, C_sigma: 0.01, H_sigma: 1}}")
    (tmp_path / "list.yaml").write_text("\n".join(lines))
    listed = l2m.read_calibration(tmp_path / "list.yaml")
    found = l2m.localise(drive.recording, listed, WORLD, options=OPTIONS)
    # The same sigmas as those of the calibration that the fixture has: the same poses.
    np.testing.assert_allclose(
        found.result.trajectory.p, localised().result.trajectory.p, atol=1e-6
    )


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("sensors: {}", "sensors"),
        ("sensors: {a: {t_lidar_mag: [0, 0, 0], t_sigma: 0}}", "t_sigma: Input should be greater"),
        ("sensors: {a: {t_lidar_mag: [0, 0]}}", "t_lidar_mag"),
        (
            "sensors: {a: {t_lidar_mag: [0, 0, 0], C: [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]}}",
            "flipped",
        ),
        ("- 1", "not a calibration file"),
    ],
)
def test_what_is_no_list_is_one_line(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "list.yaml"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=told) as error:
        read_sensors(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)
