"""Penalties of what the weights of a field take up have the slopes of the cost they stand for.

Each is linear about the places at which it was made, with the covariance of the weights as it was
there.
"""

from collections.abc import Callable

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.maps.potential import PotentialBasis, PotentialHyperparameters
from l2m_gtsam.slam.options import TileOptions
from l2m_gtsam.slam.unknown_field.linear_field import LinearField
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior, WaveTile
from l2m_gtsam.slam.unknown_field.whole_field import WholeField

SIDE_M = 1e-4  # of differences
# The penalty's own are over 1 mm to either side: by a wave of 4 / 0.4 m their third order is
# (1e-2)^2 / 6 of a slope, 2e-5.
EXACT = 1e-4
POINTS = np.random.default_rng(3).uniform(-1.0, 1.0, (30, 3))
VARIANCE = np.full((30, 3), 0.3**2)


def whole_field() -> LinearField:
    prior = PotentialHyperparameters(sigma=2.0, length=0.4)
    corner = np.full(3, 1.6)
    return WholeField.of(PotentialBasis.over(-corner, corner, prior, 200))


def tile() -> LinearField:
    prior = FieldPrior(Hyperparameters(), Resolution(4.0, 4.0), TileOptions())
    return WaveTile.about(prior, np.eye(3), POINTS)


def volume(field: LinearField, points: FloatArray) -> float:
    known = np.eye(len(field)) + field.information(points, VARIANCE)
    return 0.5 * float(np.linalg.slogdet(known)[1])


def parameters(field: LinearField, points: FloatArray) -> float:
    """Return half of their number, with the covariance of the weights as at the given points."""
    covariance = np.linalg.inv(np.eye(len(field)) + field.information(POINTS, VARIANCE))
    return 0.5 * float(np.trace(covariance @ field.information(points, VARIANCE) @ covariance))


@pytest.mark.parametrize(("made", "cost"), [(whole_field, volume), (tile, parameters)])
def test_a_penalty_has_the_slope_of_its_cost(
    made: Callable[[], LinearField], cost: Callable[[LinearField, FloatArray], float]
) -> None:
    field = made()
    penalty = field.penalty(POINTS, VARIANCE)
    slope = penalty.value[:, None] * penalty.slope
    for n, axis in ((0, 0), (7, 1), (29, 2)):
        step = np.zeros_like(POINTS)
        step[n, axis] = SIDE_M
        ahead, behind = cost(field, POINTS + step), cost(field, POINTS - step)
        assert slope[n, axis] == pytest.approx((ahead - behind) / (2 * SIDE_M), rel=EXACT, abs=1e-6)


def test_the_readings_share_the_effective_number_of_parameters() -> None:
    """In one field the squares of the penalty are ``tr K (K + I)^-1``."""
    field = whole_field()
    information = field.information(POINTS, VARIANCE)
    expected = np.trace(np.linalg.solve(np.eye(len(field)) + information, information))
    assert field.penalty(POINTS, VARIANCE).parameters == pytest.approx(expected)
