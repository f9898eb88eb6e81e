"""What may go wrong on a drive: the poses stay right, or it is said that they are not."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.data import FieldSeries, FloatArray, KnownSensor, Recording, RigidTransform
from l2m_gtsam.errors import SyncError
from l2m_gtsam.progress import silent
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.localisation import judge_localisation
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.localisation import LocalisationResult, LocalisationStatus
from l2m_gtsam.records.scans import PoseFix, ScanEvidence
from l2m_gtsam.slam.localisation import Localisation, localise
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.record import RecordContext, localisation_record
from tests.drives.faults import jumped, opened, shift
from tests.drives.slam import COARSE, WIDE, SlamDrive, calibrated, rounds, slam_drive
from tests.support.pose_errors import pose_nees, position_error
from tests.worlds.exact import dipole_world, random_sensors

WORLD = dipole_world(1)
SECONDS = 30
HALF = 300  # readings
FAR_APART = COARSE.model_copy(update={"distance_m": 0.4})  # enough to tell another building
STUDY = pytest.mark.study


def found(
    drive: SlamDrive, known: CalibrationResult, seed: int = 1, **options: object
) -> Localisation:
    chosen = SlamOptions.model_validate({"key_poses": COARSE, **options})
    return localise(drive.recording, dipole_world(seed), known, chosen, silent)


@pytest.fixture(scope="module")
def sensors() -> tuple[KnownSensor, ...]:
    return random_sensors(11, 2)


@pytest.fixture(scope="module")
def drive(sensors: tuple[KnownSensor, ...]) -> SlamDrive:
    """18 m with odometry that drifts by 1 %."""
    return slam_drive(WORLD, sensors, rounds(SECONDS), np.random.default_rng(11))


@pytest.fixture(scope="module")
def plain(drive: SlamDrive, sensors: tuple[KnownSensor, ...]) -> LocalisationResult:
    return found(drive, calibrated(sensors)).result


def error(drive: SlamDrive, result: LocalisationResult) -> float:
    return position_error(drive.truth, result.trajectory)


def replaced(drive: SlamDrive, series: dict[int, FieldSeries]) -> SlamDrive:
    """Return a drive on which some sensors recorded something else."""
    old = drive.recording.series
    new = tuple(series.get(k, each) for k, each in enumerate(old))
    return replace(drive, recording=replace(drive.recording, series=new))


def reading(drive: SlamDrive, sensor: int, start: int, value: FloatArray | float) -> SlamDrive:
    """Return a drive on which a sensor reads a value from some reading on."""
    series = drive.recording.series[sensor]
    field = series.field.copy()
    field[start:] = value
    return replaced(drive, {sensor: replace(series, field=field)})


# Odometry jumps.


def test_jumps_of_odometry_do_no_harm(
    drive: SlamDrive, sensors: tuple[KnownSensor, ...], plain: LocalisationResult
) -> None:
    """A slip, a snap to the side, a turn, and an origin that is set anew, within 25 s."""
    shifts = (
        shift(100, 0.5, 0, 1.0),
        shift(250, 0.0, 10),
        shift(400, 0.5, -10, 2),
        shift(500, 30, 120),
    )
    odometry = jumped(drive.recording.trajectory, *shifts)
    recording = replace(drive.recording, trajectory=odometry)
    result = found(replace(drive, recording=recording), calibrated(sensors)).result
    assert result.status is LocalisationStatus.LOCALISED
    # Four steps of 3 cm are known a little less well: a few mm.
    assert error(drive, result) < error(drive, plain) + 0.01
    assert pose_nees(drive.truth, result.trajectory).mean() < 12
    assert result.notes[0].startswith("odometry jumps by 0.50 m and 0.0 deg 5.1 s after")
    assert result.notes[3] == "odometry jumps 1 more times"
    # What is removed is compared with odometry as it was recorded, with the origin set anew.
    assert result.drift.end_m > 20


def test_jumps_that_are_believed_do_harm(
    drive: SlamDrive, sensors: tuple[KnownSensor, ...]
) -> None:
    """So the test above tests something."""
    odometry = jumped(drive.recording.trajectory, shift(250, 0.5, 10, 1.0), shift(400, 0.5, -10))
    spoilt = replace(drive, recording=replace(drive.recording, trajectory=odometry))
    believed = {"position_m": 1e3, "rotation_deg": 1e3}
    result = found(spoilt, calibrated(sensors), jumps=believed).result
    assert error(drive, result) > 0.1


# Sensors that die.


@pytest.mark.parametrize("value", [None, 0.0, np.nan])
def test_a_sensor_that_dies_beside_another_is_named(
    drive: SlamDrive, sensors: tuple[KnownSensor, ...], value: float | None
) -> None:
    """Half way, on its last value, on zeros, or on NaN."""
    last = drive.recording.series[0].field[HALF] if value is None else value
    result = found(reading(drive, 0, HALF, last), calibrated(sensors)).result
    assert result.status is LocalisationStatus.LOCALISED
    assert error(drive, result) < 0.06  # one sensor on the second half: 2 cm more than with two
    assert pose_nees(drive.truth, result.trajectory).mean() < 12
    assert [each.rejected for each in result.sensors] == [0, 0]
    (note,) = result.notes
    assert note.startswith("mag_00 is dead for 50% of the drive")


def test_a_sensor_that_was_dead_from_the_start_is_left_out(
    drive: SlamDrive, sensors: tuple[KnownSensor, ...]
) -> None:
    result = found(reading(drive, 0, 0, 3.0), calibrated(sensors)).result
    assert [each.sensor for each in result.sensors] == ["mag_01"]
    assert result.notes == ("mag_00 is left out: it has no readings, or repeats one value",)
    assert error(drive, result) < 0.06


def test_without_any_sensor_odometry_goes_on_and_says_how_far_to_trust_it(
    drive: SlamDrive, sensors: tuple[KnownSensor, ...], plain: LocalisationResult
) -> None:
    """The only one dies after a third: sigmas grow from there on, and cover the error."""
    alone = reading(drive, 0, 200, 0.0)
    alone = replace(alone, recording=replace(alone.recording, series=alone.recording.series[:1]))
    result = found(alone, calibrated(sensors[:1])).result
    assert result.status is LocalisationStatus.LOCALISED
    assert result.notes[0].startswith("mag_00 is dead for 67% of the drive, longest from")
    assert pose_nees(drive.truth, result.trajectory).mean() < 12
    sigma = position_sigmas(result)
    assert sigma[-1] > 1.5 * position_sigmas(plain)[-1]
    nothing = replace(alone.recording.series[0], field=np.zeros((599, 3)))
    with pytest.raises(SyncError, match="mag_00: it has no readings, or repeats one value"):
        found(replaced(alone, {0: nothing}), calibrated(sensors[:1]))


def position_sigmas(result: LocalisationResult) -> FloatArray:
    """Return the largest sigma of each position along an axis of the body, shape (K,)."""
    assert result.trajectory.covariance is not None
    variance = np.diagonal(result.trajectory.covariance[:, 3:, 3:], axis1=1, axis2=2)
    return np.asarray(np.sqrt(variance.max(axis=1)))


def test_a_sensor_that_lies_is_rejected(drive: SlamDrive, sensors: tuple[KnownSensor, ...]) -> None:
    """From half way on its offset wanders off by 15 uT: something was put beside it."""
    series = drive.recording.series[0]
    wander = np.zeros_like(series.field)
    wander[HALF:] = np.linspace(0, 15, len(wander) - HALF)[:, None]
    wandering = replaced(drive, {0: replace(series, field=series.field + wander)})
    result = found(wandering, calibrated(sensors)).result
    assert error(drive, result) < 0.06
    first, second = (each.rejected / each.readings for each in result.sensors)
    assert 0.3 < first < 0.5
    assert second < 0.15


# LiDAR that drops out.


def fixes(drive: SlamDrive, seconds: range, sigma_m: float = 0.01) -> ScanEvidence:
    """Return poses in the map that scans would give, one per second."""
    rng, covariance = np.random.default_rng(5), np.diag(np.repeat([0.002, sigma_m], 3) ** 2)
    seen = []
    for second in seconds:
        k = 20 * second
        p = drive.truth.p[k] + sigma_m * rng.normal(size=3)
        T = RigidTransform(drive.truth.R[k], p)
        seen.append(PoseFix(int(drive.truth.stamp_ns[k]), T, covariance))
    return ScanEvidence(fixes=tuple(seen))


def test_fixes_that_stop_are_bridged_by_odometry_and_readings(
    drive: SlamDrive, sensors: tuple[KnownSensor, ...]
) -> None:
    """No scan for 15 s: sigmas grow, and shrink when scans come again."""
    options = SlamOptions.model_validate({"key_poses": COARSE})
    known, scanned = calibrated(sensors), [*range(8), *range(23, 30)]
    seen = fixes(drive, range(30))
    some = replace(seen, fixes=tuple(seen.fixes[k] for k in scanned))
    result = localise(drive.recording, WORLD, known, options, silent, evidence=some).result
    assert result.scans is not None
    assert result.scans.rejected == 0
    assert error(drive, result) < 0.03
    assert pose_nees(drive.truth, result.trajectory).mean() < 12
    seconds = 1e-9 * (result.trajectory.stamp_ns - result.trajectory.stamp_ns[0])
    sigma = position_sigmas(result)
    seen_then = sigma[(seconds < 6) | (seconds > 24)].max()
    # Within, over fields that tell little; towards its end the prior of the next fix is felt.
    assert sigma[(seconds > 9) & (seconds < 21)].max() > 1.2 * seen_then
    # Half of the drive without any.
    early = replace(seen, fixes=seen.fixes[:15])
    result = localise(drive.recording, WORLD, known, options, silent, evidence=early).result
    assert error(drive, result) < 0.05
    assert pose_nees(drive.truth, result.trajectory).mean() < 12
    assert position_sigmas(result)[-1] > 1.5 * seen_then


# Another building.


@pytest.mark.parametrize(
    ("seed", "refined"),
    [(99, False), pytest.param(7, False, marks=STUDY), pytest.param(99, True, marks=STUDY)],
)
def test_another_building_is_not_here(
    drive: SlamDrive, sensors: tuple[KnownSensor, ...], seed: int, refined: bool
) -> None:
    """Also where the calibration may bend: C by 0.05, H by 10 uT, t by 5 cm."""
    known = calibrated(sensors, sigma=WIDE, rng=np.random.default_rng(3))
    use = CalibrationUse.REFINED if refined else CalibrationUse.FIXED
    known = known if refined else calibrated(sensors)
    result = found(drive, known, seed, calibration=use.value, key_poses=FAR_APART).result
    assert result.status is LocalisationStatus.NOT_HERE
    assert "another place" in result.message


def test_another_field_where_scans_fit_is_not_here(
    drive: SlamDrive, sensors: tuple[KnownSensor, ...]
) -> None:
    """A cloud of this place beside the field of another one: readings say so."""
    options = SlamOptions.model_validate({"key_poses": FAR_APART})
    world, seen = dipole_world(99), fixes(drive, range(30))
    result = localise(
        drive.recording, world, calibrated(sensors), options, silent, evidence=seen
    ).result
    assert result.status is LocalisationStatus.NOT_HERE
    # Poses are held by the scans: what is refused is not nonsense.
    assert error(drive, result) < 0.1


# A steel door.


@pytest.fixture(scope="module")
def three() -> tuple[KnownSensor, ...]:
    return random_sensors(21, 3)


def test_a_door_that_opens_is_reported_and_does_not_pull(three: tuple[KnownSensor, ...]) -> None:
    """60 A m^2 appear 0.8 m beside the way at half time: felt over four metres of the last lap."""
    truth, known = rounds(40), calibrated(three)
    beside = truth.p[600] + truth.R[600] @ np.array([0.0, 0.8, -0.2])
    drive = slam_drive(WORLD, three, truth, np.random.default_rng(21))
    other = WORLD.with_dipoles(beside, np.array([0.0, 0.0, 60.0]))
    changed = opened(drive, slam_drive(other, three, truth, np.random.default_rng(21)), 400)
    done = found(changed, known)
    assert done.result.status is LocalisationStatus.LOCALISED
    shut = found(drive, known).result
    # Odometry alone bridges five metres: some centimetres more.
    assert error(drive, done.result) < error(drive, shut) + 0.05
    assert pose_nees(drive.truth, done.result.trajectory).mean() < 18
    # Nearly all that was left out is of the last lap, and near.
    solution = done.solution
    lost = ~solution.used
    away = np.linalg.norm(solution.prediction.placed.x[lost] - beside, axis=1)
    assert np.quantile(away, 0.9) < 4.0
    late = solution.drive.stamp_ns[solution.drive.readings.key_pose[lost]]
    assert np.mean(late - truth.stamp_ns[0] > 20e9) > 0.95
    written = localisation_record(done.result, solution, RecordContext(known, WORLD, {}, 0.5))
    texts = [each.text for each in judge_localisation(written, QaOptions()).reasons]
    assert any("the place has changed since it was mapped" in each for each in texts)


# Clocks.


def later(recording: Recording, sensor: int, seconds: float) -> Recording:
    """Return a recording in which the clock of a sensor is set half way."""
    series = recording.series[sensor]
    stamps = series.stamp_ns.copy()
    stamps[HALF:] += round(1e9 * seconds)
    order = np.argsort(stamps, kind="stable")
    moved = replace(series, stamp_ns=stamps[order], field=series.field[order])
    every = tuple(moved if k == sensor else each for k, each in enumerate(recording.series))
    return replace(recording, series=every)


@pytest.mark.parametrize("seconds", [0.3, -0.3])
def test_a_sensor_whose_clock_is_set_is_rejected_from_then_on(
    drive: SlamDrive, sensors: tuple[KnownSensor, ...], seconds: float
) -> None:
    """18 cm of path: most of its readings fit no more, the other sensor holds the poses."""
    shifted = replace(drive, recording=later(drive.recording, 0, seconds))
    result = found(shifted, calibrated(sensors)).result
    assert result.status is LocalisationStatus.LOCALISED
    assert error(drive, result) < 0.06
    first, second = (each.rejected / each.readings for each in result.sensors)
    assert first > 0.25
    assert second < 0.05
