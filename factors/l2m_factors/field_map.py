"""What a factor asks of a map."""

from typing import Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Jacobians = list[FloatArray] | None  # what GTSAM hands to a factor to be filled, if it wants them


class DifferentiableMap(Protocol):
    """A magnetic field that can be evaluated anywhere, satisfied by shape and not by descent."""

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return the field and its gradient at points of the map frame.

        The result must be finite and smooth everywhere, also where a trial step of an optimiser
        leaves the region in which the map has data.

        Parameters
        ----------
        points
            Positions in metres, shape (N, 3).

        Returns
        -------
        field
            Field in the map frame in microtesla, shape (N, 3).
        gradient
            ``gradient[n, i, j]`` = dB_i/dx_j in microtesla per metre, shape (N, 3, 3).
        """
