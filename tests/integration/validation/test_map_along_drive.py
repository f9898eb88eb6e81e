"""A likelihood with errors of a map that were asked for near by, against one with its own."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.maps.harmonic.error_modes import ErrorModes
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.qa.metrics.coordinates import changes_of
from l2m_gtsam.validation.innovation import (
    ChangeLikelihood,
    KnownCalibration,
    change_likelihood,
    marginalise_calibration,
)
from l2m_gtsam.validation.map_along_drive import NEAR_M, MapAlongDrive
from tests.drives.calibrations import SIGMA
from tests.drives.uncertain import NOISE, SENSORS, surveyed, turning_drive

LASTS_S = 1.0
# Of a sigma of a change. Numbers of a map's errors leave out a fiftieth of its variance, which then
# counts as each reading's own; which fiftieth, depends on where they were asked for. That moves a
# change by 0.04 sigmas at most here, whether over two millimetres or over two centimetres, and the
# variance of places 5 mm away adds less.
PART = 0.1
SHARE = 2e-3  # of a sigma, and of the innovation's square, for the same reason: 8e-4 here


class Counted:
    """A map that counts how often it is asked for its errors."""

    def __init__(self, field_map: HarmonicMap) -> None:
        self._map, self.asked = field_map, 0
        self.field_and_gradient, self.query = field_map.field_and_gradient, field_map.query
        self.tile_of, self.weights_in = field_map.tile_of, field_map.weights_in

    def errors_over(self, points: FloatArray, /) -> ErrorModes:
        self.asked += 1
        return self._map.errors_over(points)


@pytest.fixture(scope="module")
def field_map() -> HarmonicMap:
    return surveyed(0, 500)


@pytest.fixture(scope="module")
def readings() -> Readings:
    return turning_drive(300).alone(0)


def known(by: float) -> KnownCalibration:
    """Return the calibration with the sensor moved by so many metres along each axis."""
    vector = np.append(SENSORS[0].vector(), 0.0)
    vector[:3] += by
    return KnownCalibration(vector, NOISE, np.zeros((0, 3)))


def likelihood(
    readings: Readings, field_map: HarmonicMap | MapAlongDrive, calibration: KnownCalibration
) -> ChangeLikelihood:
    P = np.zeros((16, 16))
    P[:15, :15] = np.diag(SIGMA**2)
    told = change_likelihood((readings,), field_map, (calibration,), LASTS_S)
    return marginalise_calibration(told, P, changes_of(calibration.vector[3:12].reshape(3, 3)))


def assert_same(found: ChangeLikelihood, own: ChangeLikelihood) -> None:
    """Compare a change of place, of distortion and of both, and what nothing explains."""
    assert found.squared == pytest.approx(own.squared, rel=SHARE)
    for part in (range(3), range(3, 15), range(15)):
        (change, P), (own_change, Q) = (each.estimate(part) for each in (found, own))
        sigma = np.sqrt(np.diag(Q))
        np.testing.assert_array_less(np.abs(change - own_change), PART * sigma)
        np.testing.assert_allclose(np.sqrt(np.diag(P)), sigma, rtol=SHARE)


@pytest.mark.parametrize("by", [0.002, 0.005, 0.015])
def test_remembered_errors_give_the_same_likelihood(
    field_map: HarmonicMap, readings: Readings, by: float
) -> None:
    """At a place so many metres along each axis from the one that they were asked for."""
    counted = Counted(field_map)
    along = MapAlongDrive(counted)
    likelihood(readings, along, known(0.0))
    assert_same(likelihood(readings, along, known(by)), likelihood(readings, field_map, known(by)))
    assert counted.asked == 1


def test_errors_further_away_are_those_of_the_place(
    field_map: HarmonicMap, readings: Readings
) -> None:
    """As a map without a memory tells them, but for rounding."""
    counted = Counted(field_map)
    along = MapAlongDrive(counted)
    likelihood(readings, along, known(0.0))
    found = likelihood(readings, along, known(2 * NEAR_M))
    own = likelihood(readings, field_map, known(2 * NEAR_M))
    assert counted.asked == 2
    assert found.squared == pytest.approx(own.squared, rel=1e-9)
    np.testing.assert_allclose(abs(found.root), abs(own.root), rtol=0, atol=1e-6 * own.root.max())
