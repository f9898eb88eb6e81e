"""From arrays to results: as many lines as a user writes, and the same numbers as elsewhere."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import l2m_gtsam as l2m
from l2m_gtsam.api.results import JudgedCalibration
from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.errors import ConfigError, InputError
from tests.drives.localised import OPTIONS, WORLD, driven, localised
from tests.drives.verdict import drive


@pytest.fixture(scope="module")
def found() -> JudgedCalibration:
    whole = drive()
    poses, series = whole.recording.trajectory, whole.recording.series
    fields = {each.sensor: (each.stamp_ns, each.field) for each in series}
    recording = l2m.drive(poses.stamp_ns, poses.p, poses.R, fields)
    return l2m.calibrate(recording, whole.field_map, options=whole.options)


def test_arrays_give_what_a_recording_gives(found: JudgedCalibration) -> None:
    whole = drive()
    expected = calibrate(whole.recording, whole.field_map, whole.options)
    for one, other in zip(found.result.sensors, expected.sensors, strict=True):
        np.testing.assert_allclose(one.t_lidar_mag, other.t_lidar_mag, atol=1e-9)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6)
    assert found["mag_0"].sensor == "mag_0"


def test_a_result_shows_itself(found: JudgedCalibration) -> None:
    frame = found.to_frame()
    assert isinstance(frame, pd.DataFrame)
    assert list(frame["sensor"]) == [each.sensor for each in found.result.sensors]
    np.testing.assert_allclose(frame["t_x_m"], [s.t_lidar_mag[0] for s in found.result.sensors])
    assert set(frame["verdict"]) == {"pass"}
    plain = found.to_dict()
    assert json.loads(json.dumps(plain)) == plain
    assert plain["verdict"]["level"] == "pass"
    page = found._repr_html_()
    assert page.startswith("<p>verdict: PASS</p><table>")
    assert page.count("<tr>") == 1 + len(frame)


def test_a_sensor_that_is_not_there_is_named_beside_those_that_are(
    found: JudgedCalibration,
) -> None:
    for asked in (found, found.result, found.verdict):
        with pytest.raises(KeyError) as error:
            asked["mag_7"]
        assert isinstance(error.value, InputError)
        assert str(error.value).startswith("no sensor named 'mag_7'; there are mag_0")
        assert "mag_7" not in asked
        assert list(asked) == [each.sensor for each in found.result.sensors]
        assert all(name in asked for name in asked)


def test_names_are_shown_as_text(found: JudgedCalibration) -> None:
    sensor = replace(found.result.sensors[0], sensor="<script>")
    verdict = replace(
        found.verdict, sensors=(replace(found.verdict.sensors[0], sensor="<script>"),)
    )
    page = JudgedCalibration(replace(found.result, sensors=(sensor,)), verdict)._repr_html_()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page


def test_where_a_drive_went() -> None:
    gone, known = driven()
    path = l2m.localise(gone.recording, known, WORLD, options=OPTIONS)
    expected = localised().result
    frame = path.to_frame()
    np.testing.assert_allclose(frame[["x_m", "y_m", "z_m"]], expected.trajectory.p, atol=1e-9)
    assert (frame["sigma_x_m"] > 0).all()
    assert path.to_dict()["status"] == expected.status.value
    assert path.heading() in path._repr_html_()


def test_wrong_options_are_one_line(found: JudgedCalibration) -> None:
    whole = drive()
    with pytest.raises(
        ConfigError, match=r"^unknown key 'calibration.solve.speed'; accepted here: .*robust"
    ):
        l2m.calibrate(whole.recording, whole.field_map, options={"solve": {"speed": 1}})
    with pytest.raises(InputError, match=r"^structure: of shape \(3,\)"):
        l2m.build_map(whole.recording, structure=[1.0, 2.0, 3.0])
