"""Drives that leave something open: named before and after, and no number without a mark."""

import numpy as np
import pytest

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.calibrate import calibrated as calibrate_and_keep
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.planning.motion import PlanOptions
from l2m_gtsam.planning.plan import plan
from l2m_gtsam.qa.evaluate import evaluate
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.qa.verdict.sensor import WRONG_MAP
from l2m_gtsam.records.calibration import SensorCalibration, SensorStatus
from l2m_gtsam.records.plan import DrivePlan
from tests.drives.degenerate import (
    CALM,
    NOISE,
    PLACES,
    POSTS,
    STRONG,
    UNIFORM,
    World,
    circle,
    eight,
    mounted,
    parked,
    recorded,
    straight,
)
from tests.drives.verdict import drive
from tests.worlds.exact import DipoleWorld

SOLVE = OneKeyOptions(sensor_noise_ut=NOISE)
OPEN = (SensorStatus.UNDETERMINED, SensorStatus.NOT_CONVERGED)
T = ("t_x", "t_y", "t_z")
THIRD = ("C_xz", "H_x", "C_yz", "H_y", "C_zz", "H_z")
UNSEEN = "position unobservable", "the map's gradient there is at most 0.001 uT/m"
FLAT = "third column of C against H", "along the lidar's z axis varies by no more than 0."
LEVEL = "the vehicle changes height by 0.00 m and tilts by 0.0 deg at most"


def options(places: FloatArray) -> CalibrationOptions:
    """Sensors start where they are: the question is what the drive determines, not the search."""
    start = {f"mag_{i}": tuple(place) for i, place in enumerate(places.tolist())}
    return CalibrationOptions(start=start, solve=SOLVE)


def planned(trajectory: Trajectory, world: World, places: FloatArray = PLACES) -> DrivePlan:
    recording = recorded(trajectory, world, places)
    return plan(recording, world, options(places), PlanOptions())


def calibrated(
    trajectory: Trajectory, world: World, places: FloatArray = PLACES
) -> tuple[SensorCalibration, ...]:
    return calibrate(recorded(trajectory, world, places), world, options(places)).sensors


def deviations(sensor: SensorCalibration, places: FloatArray = PLACES) -> FloatArray:
    """Errors of (t, C, H) in sigmas; zero where the sigma is infinite."""
    truth = next(each for each in mounted(places) if each.sensor == sensor.sensor)
    error = sensor.vector() - truth.vector()
    return np.asarray(error / np.sqrt(np.diag(sensor.covariance)))


CASES: dict[str, tuple[Trajectory, World, tuple[str, ...], tuple[str, ...]]] = {
    "straight line, calm": (straight(), CALM, (*T, "C_xx", "C_yy", *THIRD), ("C against H",)),
    "straight line, posts": (straight(), POSTS, ("t_z", *THIRD), ("height (t_z): ", LEVEL, *FLAT)),
    "circle, calm": (circle(), CALM, (*T, *THIRD), ("position", *FLAT)),
    "circle, uniform": (circle(), UNIFORM, (*T, *THIRD), (*UNSEEN, *FLAT)),
    "no tilt, calm": (eight(0, 0), CALM, THIRD, ("position and third", *FLAT, LEVEL)),
    "no tilt, uniform": (eight(0, 0), UNIFORM, (*T, *THIRD), (*UNSEEN, *FLAT)),
    "uniform field": (eight(), UNIFORM, T, UNSEEN),
    "one height": (
        eight(0, 0),
        POSTS,
        ("t_z", *THIRD),
        ("height (t_z): ", LEVEL, "the map's vertical gradient there is at most 0.001 uT/m", *FLAT),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_open_is_named_before_and_after(case: str) -> None:
    trajectory, world, parameters, phrases = CASES[case]
    before = planned(trajectory, world)["mag_0"]
    (after,) = calibrated(trajectory, world)
    assert after.status in OPEN
    for told in (before.undetermined, after.undetermined):
        for expected in (*parameters, *phrases):
            assert expected in " ".join(told)
    assert ". ".join(after.undetermined) in after.message
    # No number without a mark: it is true, or the sensor is said not to have converged.
    assert np.isinf(np.diag(after.covariance)[np.isinf(before.sigma)]).all()
    if after.status is SensorStatus.UNDETERMINED:
        assert np.abs(deviations(after)).max() < 5


def test_a_uniform_field_leaves_c_and_h_calibrated() -> None:
    (after,) = calibrated(eight(), UNIFORM)
    assert after.status is SensorStatus.UNDETERMINED
    assert np.isinf(after.t_sigma).all()
    # A field of 44 uT that turns through 17 deg of tilt, 400 readings of 0.2 uT.
    assert after.C_sigma.max() < 0.01
    assert after.H_sigma.max() < 0.5
    assert np.sqrt(np.diag(after.rotation_covariance)).max() < 0.01
    assert np.abs(deviations(after)).max() < 5


@pytest.mark.parametrize(
    ("jitter_m", "jitter_deg", "figure"),
    [(0.0, 0.0, r"\(0.00 m, 0.0 deg\)"), (0.02, 1.0, r"\(0.07 m, [01].\d deg\)")],
)
def test_a_parked_vehicle_is_named(jitter_m: float, jitter_deg: float, figure: str) -> None:
    drive, sentence = parked(jitter_m, jitter_deg), f"the vehicle did not move {figure}"
    before = planned(drive, STRONG)
    assert np.isinf(before["mag_0"].sigma).all()
    with pytest.raises(CalibrationError, match=sentence):
        raise CalibrationError(before["mag_0"].undetermined[0])
    with pytest.raises(CalibrationError, match=sentence):
        calibrated(drive, STRONG)
    # Any driving at all is better than none.
    assert before.motions[0].worst.badness < before.worst.badness


def test_a_parked_vehicle_whose_readings_are_all_kept() -> None:
    """Without thinning the rank test sees them: everything is open, and it is the parking."""
    sync = options(PLACES).sync.model_copy(update={"thin_distance_m": 0.0, "thin_angle_deg": 0.0})
    every = options(PLACES).model_copy(update={"sync": sync})
    recording = recorded(parked(), STRONG)
    (after,) = calibrate(recording, STRONG, every).sensors
    before = plan(recording, STRONG, every, PlanOptions())["mag_0"]
    assert after.status in OPEN
    assert np.isinf(np.diag(after.covariance)).all()
    for told in (before.undetermined, after.undetermined):
        (sentence,) = told
        assert sentence.startswith("everything (")
        assert sentence.endswith("the vehicle did not move (0.00 m, 0.0 deg)")


@pytest.mark.parametrize("drive", [eight(0, 0), eight(0.15, 0)])
def test_a_strong_field_determines_what_a_calm_one_does_not(drive: Trajectory) -> None:
    """The same motions where the gradient is strong: nothing is open, and the sigmas are true."""
    (after,) = calibrated(drive, STRONG)
    assert planned(drive, STRONG)["mag_0"].undetermined == after.undetermined == ()
    assert after.status is SensorStatus.SOLVED
    assert np.abs(deviations(after)).max() < 5


@pytest.mark.parametrize("drive", [straight(), circle()])
def test_a_poor_drive_through_a_strong_field_is_marked(drive: Trajectory) -> None:
    """Just determined, were everything linear: it is not, and the solve says so."""
    (after,) = calibrated(drive, STRONG)
    assert after.status is SensorStatus.NOT_CONVERGED
    assert after.undetermined


def test_two_sensors_at_one_point() -> None:
    """Each is determined by itself; that there is no baseline between them is said."""
    places = np.repeat(PLACES, 2, axis=0)
    before = planned(eight(), STRONG, places)
    one, other = calibrated(eight(), STRONG, places)
    assert [each.undetermined for each in before.sensors] == [(), ()]
    for sensor, neighbour in ((one, "mag_1"), (other, "mag_0")):
        assert sensor.status is SensorStatus.SOLVED
        assert np.abs(deviations(sensor, places)).max() < 5
        assert f"not distinguishable from {neighbour}" in sensor.message


def test_two_sensors_apart_are_not_said_to_be_at_one_point() -> None:
    places = np.array([[0.2, -0.1, 0.15], [-0.2, 0.1, 0.0]])
    for sensor in calibrated(eight(), STRONG, places):
        assert sensor.status is SensorStatus.SOLVED
        assert "told apart" not in sensor.message


def test_the_motion_that_is_missing_helps_most() -> None:
    """A drive without tilt in a uniform field: only tilting tells C's third column from H."""
    found = planned(eight(0, 0), UNIFORM)
    assert found.worst.undetermined == 9
    best = found.motions[0]
    assert best.motion in ("roll by 5 deg either way", "pitch by 5 deg either way")
    assert best.worst.undetermined == 3
    again = next(each for each in found.motions if each.motion == "the same drive once more")
    assert again.worst.undetermined == 9


@pytest.mark.parametrize("share", [0.003, 0.006, 0.01])
def test_noise_holds_no_sensor(share: float) -> None:
    """In a nearly even field the search ends anywhere, with gradients that would determine t.

    No sigma is finite that is wrong, and nobody says that the map is of another place.
    """
    place = DipoleWorld(STRONG.uniform, STRONG.positions, share * STRONG.moments)
    whole = drive(place=place, field_map=place)
    searched = CalibrationOptions()
    found = calibrate_and_keep(whole.recording, place, searched)
    for sensor in found.result.sensors:
        assert sensor.status is SensorStatus.UNDETERMINED
        assert np.isinf(sensor.t_sigma).all()
        assert np.isfinite(sensor.H_sigma[:2]).all()
    qa = QaOptions(halves=False)
    metrics = evaluate(whole.recording, found, searched, qa)
    assert WRONG_MAP not in [each.text for each in judge(found.result, metrics, qa).reasons]
