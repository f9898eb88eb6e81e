"""The likeliest path of a drive in one field, with the field's weights integrated out.

Sought in the errors of odometry and sensors, in units of their sigmas, by L-BFGS. Levenberg and
Marquardt's step in poses and weights together is short here: a stretch that moves with its field is
as likely as before, but a tangent takes the weights' way along a circle for more weight.
"""

import numpy as np
from scipy.optimize import minimize

from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.unknown_field.path_information import PathNeighbourhood

CORRECTIONS = 30  # that L-BFGS keeps


def likeliest_errors(near: PathNeighbourhood, already: FloatArray, iterations: int) -> FloatArray:
    """Return the errors, relative to an estimate, at which readings and odometry are likeliest.

    Parameters
    ----------
    near
        The density of the readings about the estimate.
    already
        Errors of the estimate, of n; each has a standard deviation of 1.
    iterations
        The most of the search, each of one or two evaluations of the density.

    Returns
    -------
    FloatArray
        Shape (n,).
    """

    def cost(errors: FloatArray) -> tuple[float, FloatArray]:
        found, every = near.density_at(errors), already + errors
        return found.cost + 0.5 * float(every @ every), found.by_errors + every

    end = minimize(
        cost,
        np.zeros(near.size),
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": iterations, "maxcor": CORRECTIONS},
    )
    return np.asarray(end.x)
