"""A short drive that was localised, for tests of what is told of it."""

from dataclasses import replace
from functools import cache

import numpy as np

from l2m_gtsam.data import Recording, SourceFile
from l2m_gtsam.progress import silent
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.localisation_file import LocalisationRecord
from l2m_gtsam.slam.localisation import Localisation, localise
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.record import RecordContext, localisation_record
from tests.drives.slam import SlamDrive, calibrated, rounds, slam_drive
from tests.worlds.exact import dipole_world, random_sensors

WORLD = dipole_world(1)
OPTIONS = SlamOptions.model_validate({"key_poses": {"readings": 2}, "calibration": "refined"})
SIGMA = np.concatenate([np.full(3, 0.01), np.full(9, 0.01), np.full(3, 1.0)])
DOOR = slice(60, 100)  # readings of every sensor beside a steel door that is shut


@cache
def driven() -> tuple[SlamDrive, CalibrationResult]:
    """Return 8 s with two sensors past a door that the map does not know."""
    sensors = random_sensors(21, 2)
    drive = slam_drive(WORLD, sensors, rounds(8), np.random.default_rng(21))
    series = []
    for each in drive.recording.series:
        field = each.field.copy()
        field[DOOR] += np.array([20.0, -12.0, 8.0])
        series.append(replace(each, field=field))
    recording = replace(drive.recording, series=tuple(series))
    known = calibrated(sensors, sigma=SIGMA, rng=np.random.default_rng(2))
    return replace(drive, recording=recording), known


def found(recording: Recording, known: CalibrationResult) -> Localisation:
    """Return a drive localised, its calibration refined."""
    done = localise(recording, WORLD, known, OPTIONS, silent)
    result = replace(
        done.result,
        map=SourceFile("map.npz", "cd" * 32),
        calibration_source=SourceFile("calibration.yaml", "ef" * 32),
    )
    return replace(done, result=result)


@cache
def localised() -> Localisation:
    """Return the drive localised."""
    drive, known = driven()
    return found(drive.recording, known)


@cache
def record() -> LocalisationRecord:
    """Return what is kept of it, with the truth."""
    drive, known = driven()
    options = {"slam": OPTIONS.model_dump(mode="json")}
    truth = SourceFile("truth.tum", "01" * 32)
    done, told = localised(), RecordContext(known, WORLD, options, 0.5, drive.truth, truth)
    return localisation_record(done.result, done.solution, told)
