"""Calibrations of drives on which something went wrong, beside the same drives without it."""

from dataclasses import dataclass

import numpy as np
import pytest

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.one_key import solve_one_key
from l2m_gtsam.calibration.start.global_start import StartOptions, find_starts
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, Readings
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.learning import LearningOptions
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.simulate.hall_drives import CalibrationDrive, calibration_drive, survey
from l2m_gtsam.simulate.steel_hall import steel_hall
from l2m_gtsam.solve.robust import Loss, RobustOptions
from l2m_gtsam.studies.honesty.drives import Disturbed, spikes
from tests.drives.disturbances import bursts, moved_steel

NOISE = 0.2
# Noises: a reading that is off by more must be found, one that is off by less must not. Between,
# one reading by itself cannot be told from noise.
TOLD, CHANGED = 5.0, 1.0
HARM = 1.5  # times the error of the clean drive (contract)
ROUGH = {"spikes": spikes, "bursts": bursts, "moved steel": moved_steel}


@dataclass(frozen=True)
class Place:
    """A hall that was surveyed, and a drive through it."""

    field_map: QueryableMap
    drive: CalibrationDrive


def place(
    seed: int, options: HarmonicOptions | None = None, sensors: int = 3, count: int = 600
) -> Place:
    hall = steel_hall(seed)
    data = survey(hall, seed, noise=NOISE)
    cloud = hall.cloud()
    field_map = HarmonicMap.fit(data.points, data.field, options, cloud=cloud)
    drive = calibration_drive(hall, seed, (0.4, 1.0), NOISE, sensors=sensors, count=count)
    return Place(field_map.compile(), drive)


@dataclass(frozen=True)
class Found:
    """Errors of t in metres, shape (S, 3), and which readings were rejected, shape (N,)."""

    error: FloatArray
    rejected: BoolArray

    @property
    def rms(self) -> float:
        """Root mean square length of the errors in metres."""
        return float(np.sqrt(np.mean(np.sum(self.error**2, axis=1))))


def calibrated(field_map: QueryableMap, drive: CalibrationDrive, loss: Loss) -> Found:
    """Search and solve without any guess."""
    options = OneKeyOptions(
        uncertainty=Uncertainty.INDEPENDENT, robust=RobustOptions(loss=loss), max_steps=30
    )
    starts = found_places(drive.readings, field_map)
    solution = solve_one_key(drive.readings, field_map, starts, options)
    return Found(solution.estimate.t - drive.truth()[:, :3], solution.rejected)


def found_places(readings: Readings, field_map: QueryableMap) -> FloatArray:
    found = find_starts(readings, field_map, np.zeros(3), StartOptions())
    return np.stack([np.zeros(3) if each is None else each.t_lidar_mag for each in found])


@pytest.fixture(scope="module")
def hall() -> Place:
    """A map that is learnt in small windows."""
    return place(1, HarmonicOptions(learning=LearningOptions(modes=150)), sensors=2, count=500)


@pytest.fixture(scope="module")
def clean(hall: Place) -> Found:
    return calibrated(hall.field_map, hall.drive, Loss.TRUNCATED)


def test_a_clean_drive_keeps_its_readings(clean: Found) -> None:
    # One in 10,000 passes the limit; 0.1 are expected of 1,000.
    assert clean.rejected.sum() <= 3


@pytest.mark.parametrize("name", ["spikes", "bursts"])
def test_what_is_wrong_for_a_while_is_found_and_does_no_harm(
    name: str, hall: Place, clean: Found
) -> None:
    rough = ROUGH[name](hall.drive, 1)
    found = calibrated(hall.field_map, rough.drive, Loss.TRUNCATED)
    assert found.rms <= HARM * clean.rms
    assert recall(found, rough) >= 0.9
    assert precision(found, rough) >= 0.9


def test_a_changed_place_is_found_and_does_little_harm(hall: Place) -> None:
    """Against the same solve that takes all readings in; error ratios are for many halls below."""
    rough = moved_steel(hall.drive, 1)
    found, trusting = (
        calibrated(hall.field_map, rough.drive, loss) for loss in (Loss.TRUNCATED, Loss.SQUARED)
    )
    assert found.rms < 0.5 * trusting.rms
    assert recall(found, rough) >= 0.9
    assert precision(found, rough) >= 0.9


@pytest.mark.parametrize("loss", [Loss.HUBER, Loss.CAUCHY])
def test_softer_losses_pull_less_and_reject_nothing(loss: Loss, hall: Place, clean: Found) -> None:
    rough = spikes(hall.drive, 1)
    found = calibrated(hall.field_map, rough.drive, loss)
    assert not found.rejected.any()
    # Each spike still pulls a little: a few times the error of the clean drive, not hundreds.
    assert found.rms < 5 * clean.rms


def recall(found: Found, rough: Disturbed) -> float:
    """Return the share found of what is plainly wrong."""
    return float(found.rejected[rough.change > TOLD * NOISE].mean())


def precision(found: Found, rough: Disturbed) -> float:
    """Return the share of what was rejected that is wrong at all."""
    return float((rough.change[found.rejected] > CHANGED * NOISE).mean())


@pytest.mark.study
@pytest.mark.parametrize("name", ROUGH)
def test_over_many_halls(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Ten halls and drives: error beside the clean drive's, recall and precision of all."""
    errors, cleans, found_share, right_share = [], [], [], []
    for seed in range(1, 11):
        there = place(seed)
        rough = ROUGH[name](there.drive, seed)
        found = calibrated(there.field_map, rough.drive, Loss.TRUNCATED)
        errors.append(found.rms)
        cleans.append(calibrated(there.field_map, there.drive, Loss.TRUNCATED).rms)
        found_share.append(recall(found, rough))
        right_share.append(precision(found, rough))
    ratio = float(np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(cleans))))
    with capsys.disabled():
        print(
            f"\n{name}: error {ratio:.2f} times that of clean drives, recall "
            f"{np.mean(found_share):.3f}, precision {np.mean(right_share):.3f}"
        )
    assert ratio <= HARM
    assert np.mean(found_share) >= 0.9
    assert np.mean(right_share) >= 0.9
