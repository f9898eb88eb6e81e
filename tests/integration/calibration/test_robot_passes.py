"""Sigmas of a real robot's sensors, each pass in the map of the other three, with all defaults.

Truth are the places of the markers on the sensors. One sensor is 4 mm further along y than its
marker, against the other two, in all passes: about as much as errors may be here.
"""

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import FloatArray
from l2m_gtsam.studies.slam_array.robot import SENSORS, assumed_sensors, robot_pass
from tests.drives.robot import map_by

RUNS = (1, 2, 3, 4)
INSIDE = 5.991  # of chi-square with two degrees of freedom, 95 %


@dataclass(frozen=True)
class Passes:
    """Errors of x and y in metres, (4, 3, 2), and what is stated of them, (4, 3, 2, 2)."""

    errors: FloatArray
    covariances: FloatArray

    @property
    def squared(self) -> FloatArray:
        """Squared distances of all passes and sensors in sigmas, shape (4, 3)."""
        return distances(self.errors, self.covariances)


def distances(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    white = np.linalg.solve(covariances, errors[..., None])[..., 0]
    return np.asarray(np.sum(errors * white, axis=-1))


@pytest.fixture(scope="module")
def passes(shared_data: Path) -> Passes:
    recordings = {run: robot_pass(shared_data, run) for run in RUNS}
    places = assumed_sensors(shared_data)
    errors, covariances = np.empty((4, 3, 2)), np.empty((4, 3, 2, 2))
    for row, run in enumerate(RUNS):
        field_map = map_by([recordings[other] for other in RUNS if other != run])
        result = calibrate(recordings[run], field_map, CalibrationOptions())
        for column, name in enumerate(SENSORS):
            found = result[name]
            errors[row, column] = (found.t_lidar_mag - places[name].t_lidar_mag)[:2]
            covariances[row, column] = found.covariance[:2, :2]
    return Passes(errors, covariances)


@pytest.mark.study
def test_errors_are_as_large_as_they_are_said_to_be(passes: Passes) -> None:
    """Two are expected in the mean; 3.5 when this was written."""
    assert 1 < passes.squared.mean() < 4


@pytest.mark.study
@pytest.mark.xfail(
    reason="10; the others at 6.2 and 11.0: markers are millimetres beside their sensors, one "
    "against two by 4 to 5 mm along y in all passes and maps",
    strict=True,
)
def test_truth_is_inside_as_often_as_it_should_be(passes: Passes) -> None:
    """Of 12, 11.4 are expected."""
    assert np.count_nonzero(passes.squared < INSIDE) >= 11


@pytest.mark.study
def test_errors_are_a_few_millimetres(passes: Passes) -> None:
    """Root mean square of x and y; 2.7 mm when this was written."""
    assert np.sqrt(np.mean(passes.errors**2)) < 0.003


@pytest.mark.study
@pytest.mark.xfail(
    reason="0.37: maps of two passes have two of three passes in common, and sigmas of each count "
    "the errors of these",
    strict=True,
)
def test_passes_differ_by_as_much_as_is_said(passes: Passes) -> None:
    """Half of it at least, were the errors of different passes independent."""
    each = []
    for i, j in combinations(range(len(RUNS)), 2):
        apart = passes.errors[i] - passes.errors[j]
        each.append(distances(apart, passes.covariances[i] + passes.covariances[j]) / 2)
    assert 0.5 < np.mean(each) < 2
