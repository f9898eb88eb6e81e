"""Whether a validation of a good calibration says that it is good. Long: `make study` runs it."""

from dataclasses import dataclass

import numpy as np
import pytest

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import FieldSeries, KnownSensor, Recording, SourceFile
from l2m_gtsam.maps.build import MapOptions, build_map
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.recording.sync import SyncOptions
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.records.validation import ValidatedSensor
from l2m_gtsam.simulate.hall_drives import CLEARANCE_M, calibration_drive, survey
from l2m_gtsam.simulate.steel_hall import SteelHall, steel_hall
from l2m_gtsam.validation.validate import validate

pytestmark = pytest.mark.study

HEIGHTS = (0.4, 0.7, 1.0)
SPAN = (0.4, 1.0)
NOISE = 0.2
SENSORS = 3
READINGS = 220
EVERY = SyncOptions(thin_distance_m=0, thin_angle_deg=0)


@dataclass(frozen=True)
class Validated:
    """What is found of one sensor on one drive through a hall."""

    hall: int
    figures: ValidatedSensor


def validated_drives(halls: int, drives: int, seed: int = 500) -> list[Validated]:
    """Return what is found in halls with two surveys each: so many drives after each calibration.

    Vehicle and sensors are the same on all drives through a hall.
    """
    return [each for number in range(halls) for each in _of_hall(seed + number, drives)]


def _of_hall(seed: int, drives: int) -> list[Validated]:
    hall = steel_hall(seed)
    calibration_map, validation_map = (surveyed(hall, seed, k) for k in (0, 1))
    sensors = calibration_drive(hall, seed, SPAN, NOISE, SENSORS, READINGS).sensors
    start = {s.sensor: (s.t_lidar_mag + 0.02).tolist() for s in sensors}
    solve = OneKeyOptions(uncertainty=Uncertainty.FULL, largest_offset_s=0.0)
    options = CalibrationOptions(sync=EVERY, start=start, solve=solve)
    calibration = calibrate(along(hall, sensors, seed, 0), calibration_map, options)
    found = []
    for number in range(1, drives + 1):
        other = along(hall, sensors, seed, number)
        outcome = validate(other, validation_map, calibration, options, 1e-3)
        found += [Validated(seed, each) for each in outcome.sensors]
    return found


def surveyed(hall: SteelHall, seed: int, number: int) -> FieldMap:
    """Return the map of one of several surveys of a hall."""
    read = survey(hall, 1000 * number + seed, HEIGHTS, NOISE)
    return build_map(read.points, read.field, MapOptions(), hall.cloud())


def along(hall: SteelHall, sensors: tuple[KnownSensor, ...], seed: int, number: int) -> Recording:
    """Return what sensors read on a drive through a hall, each with noise of its own."""
    seeds = [1000 * seed + number, 9]
    trajectory = calibration_drive(hall, seeds[0], SPAN, NOISE, 1, READINGS).trajectory
    rng, series = np.random.default_rng(seeds), []
    for sensor in sensors:
        x = trajectory.R @ sensor.t_lidar_mag + trajectory.p
        free = np.flatnonzero(hall.free(x, CLEARANCE_M))
        rows = free[np.linspace(0, len(free) - 1, READINGS).round().astype(np.int64)]
        B = hall.world.field(x[rows])
        b = np.einsum("nji,nj->ni", trajectory.R[rows], B)
        field = sensor.distortion.apply(b) + NOISE * rng.standard_normal(b.shape)
        series.append(FieldSeries(sensor.sensor, "/m", "m", trajectory.stamp_ns[rows], field))
    return Recording(trajectory, tuple(series), SourceFile(f"{number}.bag", str(number)))


def test_innovations_are_as_large_as_stated() -> None:
    """12 drives of 3 sensors over maps of other surveys than those of the calibrations.

    Measured: NIS per degree of freedom 0.985, 35 of 36 in the band of 95 %, the parameters' 14.7 of
    15, no change named. Four maps are not many: sensors of a hall share calibration and maps.
    """
    found = [each.figures for each in validated_drives(halls=4, drives=3)]
    assert len(found) == 36
    ratios = [each.nis.ratio for each in found]
    assert np.mean(ratios) == pytest.approx(1, abs=0.06)
    assert sum(each.nis.consistent for each in found) >= 31
    parameters = [each.parameters.value / each.parameters.freedom for each in found]
    # were all 36 independent, this would be three standard errors
    assert np.mean(parameters) == pytest.approx(1, abs=0.2)
    assert sum(bool(each.changes) for each in found) <= 1
