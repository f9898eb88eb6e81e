r"""The field of a source: a short bar of steel, a dipole where it has no length.

.. math::
    B(x) = \sum_k w_k \, b(x - p - s_k a; m), \quad
    b(r; m) = \frac{\mu_0}{4 \pi} \left( \frac{3 r (m \cdot r)}{r^5} - \frac{m}{r^3} \right)

with nodes ``s_k`` and weights ``w_k`` of Gauss and Legendre's quadrature over the bar from
``p - a`` to ``p + a``. The moment m is spread evenly along it.
"""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FieldAndGradient, FloatArray
from l2m_gtsam.maps.harmonic.dipoles import add_dipoles, write_moment_rows

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
        s, w = (NODES, WEIGHTS / 2) if self.is_bar else POINT
        return self._sums(points, self._places(s), w)

    def derivatives(self, points: FloatArray) -> FloatArray:
        """Return derivatives of the field by all parameters, shape (N, 3, 9)."""
        # Of a dipole, too: the length of a bar starts to count with its square.
        places, w = self._places(NODES), WEIGHTS / 2
        rows = np.empty((3 * len(places), 3, len(points)))
        write_moment_rows(points, places, rows)
        by_moment = UT_M3 * np.tensordot(w, rows.reshape(len(w), 3, 3, -1), 1).T
        # A source that moves one way is seen as from points that move the other way.
        by_place, by_half_axis = (-self._sums(points, places, share)[1] for share in (w, w * NODES))
        return np.concatenate([by_place, by_moment, by_half_axis], axis=2)

    def _sums(self, points: FloatArray, places: FloatArray, share: FloatArray) -> FieldAndGradient:
        """Return what nodes (K, 3) with shares of the moment, (K,), make at points."""
        field, gradient = np.zeros((len(points), 3)), np.zeros((len(points), 3, 3))
        add_dipoles(points, places, UT_M3 * np.outer(share, self.moment), field, gradient)
        return field, gradient

    def _places(self, s: FloatArray) -> FloatArray:
        return np.ascontiguousarray(self.position + np.outer(s, self.half_axis))
