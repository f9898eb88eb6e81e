r"""The field of a source: a short bar of steel, a dipole where it has no length.

.. math::
    B(x) = \sum_k w_k \, b(x - p - s_k a; m), \quad
    b(r; m) = \frac{\mu_0}{4 \pi} \left( \frac{3 r (m \cdot r)}{r^5} - \frac{m}{r^3} \right)

with nodes ``s_k`` and weights ``w_k`` of Gauss and Legendre's quadrature over the bar from
``p - a`` to ``p + a``. The moment m is spread evenly along it.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from l2m_gtsam.data import FieldAndGradient, FloatArray
from l2m_gtsam.maps.harmonic.dipoles import SOFT, add_dipoles
from l2m_gtsam.maps.harmonic.triangular import FAST

UT_M3 = 0.1  # field of 1 A m^2 at 1 m: mu_0 / (4 pi) in uT m^3 per A m^2
POSITION, MOMENT, HALF_AXIS = slice(0, 3), slice(3, 6), slice(6, 9)
PARAMETERS = 9
# A bar is seen from no nearer than about its nodes' distance: six of them on one of 2 m.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(6)
POINT = np.zeros(1), np.ones(1)


@dataclass(frozen=True)
class SourceShape:
    """A source of a static field in the map.

    Attributes
    ----------
    vector
        Position in metres, moment in A m^2, and half of the bar's length along its axis in metres
        (zero for a dipole), map frame, shape (9,).
    """

    vector: FloatArray

    @classmethod
    def dipole(cls, position: FloatArray, moment: FloatArray) -> "SourceShape":
        """Return a source without length."""
        return cls(np.concatenate([position, moment, np.zeros(3)]))

    def with_half_axis(self, half_axis: FloatArray) -> "SourceShape":
        """Return the same as a bar, metres, shape (3,)."""
        return SourceShape(np.append(self.vector[:6], half_axis))

    @property
    def position(self) -> FloatArray:
        """Its middle in the map in metres, shape (3,)."""
        return self.vector[POSITION]

    @property
    def moment(self) -> FloatArray:
        """Moment in the map frame in A m^2, shape (3,)."""
        return self.vector[MOMENT]

    @property
    def half_axis(self) -> FloatArray:
        """From its middle to one end in metres, shape (3,)."""
        return self.vector[HALF_AXIS]

    @property
    def is_bar(self) -> bool:
        """Whether it has a length."""
        return bool(self.half_axis.any())

    def field_and_gradient(self, points: FloatArray) -> FieldAndGradient:
        """Return the field in uT, (N, 3), and its gradient in uT/m, (N, 3, 3), at points in m."""
        s, w = self._nodes()
        field, gradient = np.zeros((len(points), 3)), np.zeros((len(points), 3, 3))
        add_dipoles(points, self._places(s), UT_M3 * np.outer(w, self.moment), field, gradient)
        return field, gradient

    def derivatives(self, points: FloatArray) -> FloatArray:
        """Return derivatives of the field by all parameters, shape (N, 3, 9)."""
        J = np.zeros((len(points), 3, PARAMETERS))
        # Of a dipole, too: the length of a bar starts to count with its square.
        add_derivatives(points, self._places(NODES), self.moment, NODES, WEIGHTS / 2, J)
        return J

    def _nodes(self) -> tuple[FloatArray, FloatArray]:
        return (NODES, WEIGHTS / 2) if self.is_bar else POINT

    def _places(self, s: FloatArray) -> FloatArray:
        return np.ascontiguousarray(self.position + np.outer(s, self.half_axis))


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def add_derivatives(
    points: FloatArray,
    places: FloatArray,
    moment: FloatArray,
    nodes: FloatArray,
    weights: FloatArray,
    J: FloatArray,
) -> None:
    """Add derivatives of a bar's field by its parameters, shape (N, 3, 9).

    Parameters
    ----------
    points
        Metres, shape (N, 3).
    places, nodes, weights
        Of K nodes: metres, shape (K, 3), along the bar from -1 to 1, and shares of the moment.
    moment
        In A m^2, shape (3,).
    """
    for n in range(len(points)):
        for k in range(len(nodes)):
            r = (
                points[n, 0] - places[k, 0],
                points[n, 1] - places[k, 1],
                points[n, 2] - places[k, 2],
            )
            inverse = 1.0 / max(r[0] * r[0] + r[1] * r[1] + r[2] * r[2], SOFT * SOFT)
            cube = UT_M3 * weights[k] * inverse * np.sqrt(inverse)
            fifth = 3.0 * cube * inverse
            pull = fifth * (moment[0] * r[0] + moment[1] * r[1] + moment[2] * r[2])
            steep = -5.0 * pull * inverse
            for i in range(3):
                for j in range(3):
                    by_moment = fifth * r[i] * r[j]
                    by_place = -fifth * (r[i] * moment[j] + moment[i] * r[j]) - steep * r[i] * r[j]
                    if i == j:
                        by_moment -= cube
                        by_place -= pull
                    J[n, i, j] += by_place
                    J[n, i, 3 + j] += by_moment
                    J[n, i, 6 + j] += nodes[k] * by_place
