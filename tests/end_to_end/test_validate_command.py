"""`l2m validate` on what `l2m calibrate` wrote."""

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.batch.validation import ValidationRequest, validate_calibration
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.progress import silent
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.yaml_file import read_yaml, write_yaml
from tests.drives.yard import CalibratedYard, H, written
from tests.support.command_line import complaint_here, l2m
from tests.support.map_files import copy_map
from tests.support.records import validation_in
from tests.worlds.yard import NOISE


def changed_file(calibration: Path, path: Path, **changes: object) -> Path:
    """Write a calibration in which some entries of the sensor are others; None leaves one out.

    As one that is made by hand: without an id.
    """
    content = read_yaml(calibration, CalibrationError)
    del content["id"]
    content["sensors"]["mag"] |= changes
    for key in [key for key, value in changes.items() if value is None]:
        del content["sensors"]["mag"][key]
    write_yaml(path, content, "")
    return path


def test_the_commands_of_the_page_run(
    calibration: Path,
    field_map: Path,
    tmp_path: Path,
    repository: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On another drive, with noise of its own; and they say that nothing has changed."""
    page = (repository / "docs" / "validate.md").read_text()
    (block,) = re.findall(r"```bash\n(.*?)```", page, re.DOTALL)
    shutil.copy(calibration, tmp_path / "calibration.yaml")
    shutil.copy(calibration, tmp_path / "old.yaml")
    copy_map(field_map, tmp_path / "map.npz")
    written(tmp_path, "ros1", seed=6)
    monkeypatch.chdir(tmp_path)
    outs = []
    for command in block.splitlines():
        name, *arguments = shlex.split(command)
        assert name == "l2m"
        outs.append(l2m(*arguments).out)
    on_drive, compared, both = outs
    assert "e_B before" in on_drive
    assert "verdict: FAIL" not in on_drive
    assert "offset H differs from the calibration" not in on_drive
    assert "No change since the old calibration" in compared
    assert "No change since the old calibration" in both
    found = validation_in(Path("validated/validation.json"))
    assert found.drive is not None
    assert found.comparison is None
    (sensor,) = found.drive.sensors
    # three axes of noise, corrected by C, and what the quick map does not know
    assert 2 * NOISE**2 < sensor.after.squared < 12 * NOISE**2
    assert "<figure>" in Path("both/validation.html").read_text()


def test_a_plain_list_is_validated_and_exported(
    calibration: Path, field_map: Path, tmp_path: Path
) -> None:
    """With sigmas of its own and no verdict; a list that is wrong by far is found to be."""
    (known,) = read_calibration(calibration).sensors
    entry = {
        "t_lidar_mag": known.t_lidar_mag.tolist(),
        "C": known.distortion.C.tolist(),
        "H": known.distortion.H.tolist(),
        "t_sigma": 0.01,
        "C_sigma": 0.02,
        "H_sigma": 0.5,
        "noise": NOISE,
    }
    listed, off = tmp_path / "list.yaml", tmp_path / "off.yaml"
    write_yaml(listed, {"sensors": {"mag": entry}}, "")
    wrong = (known.distortion.H + np.array([8.0, 0.0, 0.0])).tolist()
    write_yaml(off, {"sensors": {"mag": entry | {"H": wrong}}}, "")
    bag = written(tmp_path, "mcap", seed=8)
    for path, failed in ((listed, False), (off, True)):
        asked = ValidationRequest(path, bag, field_map, out=tmp_path / path.stem)
        found = validate_calibration(asked, silent)
        assert (found.verdict.level is Level.FAIL) == failed, path
    urdf = tmp_path / "robot.urdf"
    l2m("export", listed, "--format", "urdf", "--out", urdf)
    assert "mag" in urdf.read_text()


def test_a_magnet_on_the_vehicle_is_named(
    calibration: Path, field_map: Path, tmp_path: Path
) -> None:
    bag = written(tmp_path, "mcap", "moved", seed=7, offset=H + np.array([3.0, 0, 0]))
    asked = ValidationRequest(calibration, bag, field_map, out=tmp_path / "out")
    found = validate_calibration(asked, silent)
    told = "\n".join(found.verdict.lines(Level.PASS))
    assert "verdict: FAIL" in told
    assert "On this drive its offset H differs from the calibration by 3.0 µT" in told
    assert validation_in(tmp_path / "out" / "validation.json").verdict == found.verdict
    assert {each.role for each in found.sources} == {"calibration", "drive", "map"}


def test_its_own_drive_is_refused_in_any_container(
    place: CalibratedYard, calibration: Path, field_map: Path, tmp_path: Path
) -> None:
    """Copied by `l2m apply`, or written as another kind of bag."""
    copy = tmp_path / "copy"
    l2m("apply", place.drive, "--calibration", calibration, "--out", copy, "--despite-verdict")
    drives = [place.drive, copy, *(written(tmp_path, kind, kind) for kind in ("ros1", "sqlite3"))]
    for bag in drives:
        asked = ("--calibration", calibration, "--map", field_map, "--out", tmp_path / "out")
        said = complaint_here("validate", bag, *asked)
        assert f"{bag}: is the drive that the calibration was computed from" in said
    assert not (tmp_path / "out").exists()


def test_a_change_since_an_older_calibration(calibration: Path, tmp_path: Path) -> None:
    sensor = read_calibration(calibration)["mag"]
    shifted = (sensor.t_lidar_mag + np.array([0.3, 0.0, 0.0])).tolist()
    old = changed_file(calibration, tmp_path / "old.yaml", t_lidar_mag=shifted)
    found = validate_calibration(ValidationRequest(calibration, compare=old), silent)
    told = "\n".join(found.verdict.lines(Level.PASS))
    assert "Since the old calibration its place t has changed by 300 mm" in told
    assert "verdict: FAIL" in told


def test_bad_input(
    place: CalibratedYard, calibration: Path, field_map: Path, tmp_path: Path
) -> None:
    west = place.yard.west
    out = tmp_path / "out"

    def line(*arguments: str | Path) -> str:
        return complaint_here("validate", *arguments, "--out", out)

    own = ("--calibration", calibration)
    assert "give a BAG with --map, or --compare" in line(*own)
    assert "needs --map" in line(west, *own)
    assert "--map: goes with a BAG" in line(*own, "--map", field_map)
    assert "no such file" in line("--calibration", tmp_path / "no.yaml", "--compare", calibration)
    assert "no such file" in line(*own, "--compare", tmp_path / "no.yaml")
    assert "none of its sensors (points)" not in line(west, *own, "--map", tmp_path / "no.npz")
    without = changed_file(calibration, tmp_path / "without.yaml", covariance=None)
    assert "sensors.mag.covariance" in line("--calibration", without, "--compare", calibration)
    matrix = read_calibration(calibration)["mag"].covariance
    matrix[0, 0] = -1.0
    negative = changed_file(calibration, tmp_path / "negative.yaml", covariance=matrix.tolist())
    assert "variances must be positive" in line(*own, "--compare", negative)
    matrix[0, 0], matrix[0, 1] = 1e-6, 1.0
    crooked = changed_file(calibration, tmp_path / "crooked.yaml", covariance=matrix.tolist())
    assert "is no covariance matrix" in line(*own, "--compare", crooked)
    content = read_yaml(calibration, CalibrationError)
    content["sensors"] = {"front": content["sensors"]["mag"]}
    del content["id"]
    write_yaml(tmp_path / "front.yaml", content, "")
    shared = line(*own, "--compare", tmp_path / "front.yaml")
    assert "no sensor that both calibrations know: there are front" in shared
    stranger = line(west, "--calibration", tmp_path / "front.yaml", "--map", field_map)
    assert "none of its sensors (mag) is in the calibration (front)" in stranger
    assert not out.exists()
