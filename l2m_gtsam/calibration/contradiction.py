"""Whether readings contradict the map: it predicts a field that varies, which is not in them.

Of the map of another place, or with poses that are turned wrongly, nothing of what it predicts
beyond a field that is the same everywhere is in the readings. Shared errors of the map that could
explain that are as large as the map itself: looking for them takes minutes and finds nothing.
"""

from collections.abc import Mapping

import numpy as np

from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.view import View
from l2m_gtsam.solve.closed_form import refitted
from l2m_gtsam.solve.rank import Determinacy

# Of drives whose poses and map are right, moved steel and bad poses among them, 0.88 and more of
# what the map predicts is in the readings; of wrong ones 0.3 at most.
PRESENT = 0.5
# In a weak field noise is most of what is left, whatever the map explains: verdicts fail from 0.75.
LEFT = 0.85
SIGMAS = 3.0  # by which the share that is present must be known to be less


def is_contradicted(view: View, estimate: Estimate, tests: Mapping[int, Determinacy]) -> bool:
    """Return whether the readings of every sensor contradict the map.

    Parameters
    ----------
    view
        The readings that count, with the map's field at the estimate.
    estimate
        The optimum with independent errors.
    tests
        Rank test of each sensor: where its place is open the field says too little.
    """
    return all(
        not tests[sensor].place_open and _contradicts(view, estimate, sensor)
        for sensor in view.sensors
    )


def _contradicts(view: View, estimate: Estimate, sensor: int) -> bool:
    """Return whether hardly anything of what the map predicts is in a sensor's readings."""
    own = view.readings.sensor == sensor
    R, b, z = view.readings.R_map_lidar[own], view.b_lidar[own], view.readings.field[own]
    C, H = np.split(estimate.distortion[sensor], [9])
    predicted = b @ C.reshape(3, 3).T + H
    mean = np.einsum("nij,nj->ni", R, b).mean(axis=0)
    everywhere = np.einsum("nji,j->ni", R, mean)
    uniform, varying = refitted(everywhere, z), refitted(everywhere, predicted)
    left = float(np.sqrt(np.mean((predicted - z) ** 2)))
    # The difference of mean squares is that of the prediction, but for its product with noise.
    explained = max(uniform**2 - left**2, 0.0)
    sigma = 2 * varying * left / np.sqrt(z.size)
    return left > LEFT * uniform and explained + SIGMAS * sigma < PRESENT * varying**2
