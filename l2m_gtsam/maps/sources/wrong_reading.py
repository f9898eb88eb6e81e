"""A reading that is wrong by itself, which a source beside it would explain in part.

A spike, or a clock that is off in a turn on the spot, makes a single reading wrong.
"""

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.sources.marginal import AXES, MarginalRows


def wrong_reading(
    rows: MarginalRows, residual: FloatArray, field: FloatArray, least: float, price: float
) -> int | None:
    """Return the reading that is wrong where that explains what a source does; none otherwise.

    Both are judged by what they explain less what they have to. If one wrong reading is the better
    explanation, the source has to explain enough beside it.

    Parameters
    ----------
    rows
        N readings.
    residual
        What they differ by from all but the source, uT, shape (N, 3).
    field
        The source's, as it was fitted, uT, shape (N, 3).
    least
        What the source has to explain.
    price
        What as many parameters as a reading has axes have to; that there are as many readings to
        choose from is added here.
    """
    pulled, _ = rows.pull(residual)
    most = int(np.argmax(np.einsum("ni,ni->n", field, pulled)))
    features = np.zeros((len(rows), AXES, 1 + AXES))
    features[:, :, 0], features[most, :, 1:] = field, np.eye(AXES)
    F, g = rows.information(features), np.einsum("nim,ni->m", features, pulled)
    source = g[0] ** 2 / F[0, 0]
    reading = float(g[1:] @ np.linalg.solve(F[1:, 1:], g[1:]))
    # Elsewhere the source may change hardly any reading: then both explain the same.
    both = float(g @ np.linalg.lstsq(F, g, rcond=1e-10)[0])
    worth = reading - price - 2 * float(np.log(len(rows)))
    return most if worth > source - least and both - reading < least else None
