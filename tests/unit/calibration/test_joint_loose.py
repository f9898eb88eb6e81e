"""A variable whose prior is wider than its system is linear: against the wide prior itself."""

import gtsam
import numpy as np
import pytest

from l2m_factors import U
from l2m_gtsam.calibration.joint_information import NO_READINGS, Rows, joint_information
from l2m_gtsam.calibration.sensor_columns import SENSOR, columns_of

SPREAD = np.array([1.0, 30.0, 4.0])


@pytest.mark.parametrize("felt", [0.0, 0.01, 1.0])
def test_a_loose_variable_is_that_of_the_wide_prior(felt: float) -> None:
    rng, count = np.random.default_rng(0), 3
    own = columns_of((0,))
    columns = {U(): slice(0, count)} | {
        key: slice(count + at.start, count + at.stop) for key, at in own.items()
    }
    J = rng.normal(size=(80, count + SENSOR))
    # As far as it is a combination of the sensor's parameters the readings say nothing of it.
    J[:, 1] = J[:, count] + felt * rng.normal(size=80)
    rows = [Rows(0, np.arange(count + SENSOR), J, rng.normal(size=80), NO_READINGS)]
    narrow = joint_information(columns, rows, np.eye(count), np.zeros(count))
    wide = joint_information(columns, rows, np.diag(SPREAD**-2.0), np.zeros(count))
    found = narrow.loosened(U(), SPREAD)
    most = wide.every.max()
    # The information of one variable beside the others is exact; two at a time are so to their
    # correlation, which is small here.
    np.testing.assert_allclose(found.every, wide.every, rtol=0.02, atol=2e-3 * most)
    np.testing.assert_allclose(found.of_system((0,)), narrow.among((0,)), atol=1e-9 * most)
    assert gtsam.Symbol(U()).chr() == ord("U")
