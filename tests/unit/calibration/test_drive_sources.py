"""Steel that a drive shows: what else would explain it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array

from l2m_gtsam.calibration.drive_sources import DETECTED_UT, changed_sources
from l2m_gtsam.data import Readings
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.maps.sources.source import SourceShape
from l2m_gtsam.solve.linear_algebra import RowBlocks

N, NOISE_UT = 201, 0.01


@pytest.mark.parametrize("strength", [0.5, 20.0])
def test_weak_steel_has_a_size_as_strong_steel_has(strength: float) -> None:
    """Also where it is nowhere as strong as what is detected elsewhere: it was NaN uT there."""
    shape = SourceShape.dipole(np.array([0.0, 1.5, 0.0]), strength * np.array([0.6, 0.8, 0.0]))
    points = np.column_stack([np.linspace(-5, 5, N), np.zeros((N, 2))])
    field, _ = shape.field_and_gradient(points)
    rows = MarginalRows(
        points=points,
        residual=field,
        whitening=csr_array(eye_array(3 * N) / NOISE_UT),
        nuisance=RowBlocks.of(np.tile(np.eye(3) / NOISE_UT, (N, 1))),
        prior=np.eye(3),
        slot=np.arange(N),
    )
    R = np.tile(np.eye(3), (N, 1, 1))
    readings = Readings(("a",), np.zeros(N, int), np.arange(N), R, points, field)
    drive: Any = SimpleNamespace(
        averages=SimpleNamespace(slot=np.arange(N)),
        view=SimpleNamespace(readings=readings),
        estimate=SimpleNamespace(C=lambda: np.eye(3)[None]),
    )
    found: Any = SimpleNamespace(
        shapes=(shape,), covariance=np.eye(9), gains=np.ones(1), field=lambda _: field
    )
    (source,) = changed_sources(rows, drive, found)
    assert (source.strongest > DETECTED_UT) == (strength > 1)
    assert source.passages == 1
    for each in source.explanations:
        assert 0.2 * source.strongest < each.size < source.strongest
