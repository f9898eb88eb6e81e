"""A motor beside a sensor whose current is recorded: its field is known, and taken off."""

from dataclasses import replace

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray, Recording, ScalarSeries
from l2m_gtsam.progress import silent
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.sensor_models import MovingField
from l2m_gtsam.slam.localisation import localise
from l2m_gtsam.slam.moving_fields import without_moving_fields
from l2m_gtsam.slam.online.replay import messages
from l2m_gtsam.slam.online.session import OnlineSlam
from tests.drives.localised import OPTIONS, WORLD, driven
from tests.drives.online import driven as driven_online

H = np.array([0.8, -0.5, 0.6])  # uT per ampere


def current(stamp_ns: IntArray) -> FloatArray:
    return np.asarray(10.0 * np.sin(2e-9 * (stamp_ns - stamp_ns[0])) + 3.0)


def with_motor() -> tuple[Recording, Recording, CalibrationResult]:
    """Return a drive, the same beside a motor, and the calibration that knows its field."""
    drive, known = driven()
    first, *others = drive.recording.series
    loud = replace(first, field=first.field + current(first.stamp_ns)[:, None] * H)
    number = ScalarSeries("motor", "/motor", first.stamp_ns, current(first.stamp_ns))
    recording = replace(drive.recording, series=(loud, *others), scalars=(number,))
    field = MovingField("motor", H, np.full(3, 0.001))
    sensors = tuple(
        replace(each, moving=(field,)) if each.sensor == first.sensor else each
        for each in known.sensors
    )
    return drive.recording, recording, replace(known, sensors=sensors)


def test_poses_are_those_of_a_still_drive() -> None:
    """Off line and on line, to rounding; the refined calibration still knows of the motor."""
    plain, recording, known = with_motor()
    expected, found = (
        localise(each, WORLD, calibration, OPTIONS, silent).result
        for each, calibration in ((plain, driven()[1]), (recording, known))
    )
    np.testing.assert_allclose(found.trajectory.p, expected.trajectory.p, atol=1e-6)
    assert [each.sensor for each in found.sensors] == [each.sensor for each in expected.sensors]
    assert found.calibration is not None
    assert found.calibration.sensors[0].moving == known.sensors[0].moving
    still = without_moving_fields(recording, known, OPTIONS.regressors)
    on_line, plain_on_line = (
        driven_online(OnlineSlam(calibration, OPTIONS, WORLD), messages(each)).trajectory()
        for each, calibration in (
            (still.recording, still.calibration),
            (plain, driven()[1]),
        )
    )
    np.testing.assert_allclose(on_line.p, plain_on_line.p, atol=1e-6)


def test_a_sensor_whose_number_is_not_recorded_is_left_out() -> None:
    _, recording, known = with_motor()
    found = localise(replace(recording, scalars=()), WORLD, known, OPTIONS, silent).result
    name = known.sensors[0].sensor
    assert [each.sensor for each in found.sensors] == [known.sensors[1].sensor]
    told = f"{name} is left out: a part of its readings follows motor, which is not known"
    assert any(each.startswith(told) for each in found.notes)


def test_readings_where_a_number_is_not_known_are_none() -> None:
    _, recording, known = with_motor()
    (number,), first = recording.scalars, recording.series[0]
    part = slice(0, len(number) // 2)
    half = replace(number, stamp_ns=number.stamp_ns[part], value=number.value[part])
    still = without_moving_fields(replace(recording, scalars=(half,)), known, OPTIONS.regressors)
    inside = first.stamp_ns <= half.stamp_ns[-1]
    own = still.recording.series[0].field
    np.testing.assert_allclose(own[inside], driven()[0].recording.series[0].field[inside])
    assert np.isnan(own[~inside]).all()
    np.testing.assert_array_equal(still.recording.series[1].field, recording.series[1].field)
