"""Adding up fields and their symmetric gradients."""

from numba import njit

from l2m_gtsam.data import FloatArray

# Sums in any order and fused products: loops run in vector registers. What breaks NaN stays off.
FAST = {"reassoc", "contract", "nsz"}


@njit(cache=True, nogil=True, inline="always")
def add_symmetric(
    n: int,
    bx: float,
    by: float,
    bz: float,
    xx: float,
    yy: float,
    zz: float,
    xy: float,
    xz: float,
    yz: float,
    field: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add a field and its symmetric gradient to those of a point."""
    field[n, 0] += bx
    field[n, 1] += by
    field[n, 2] += bz
    gradient[n, 0, 0] += xx
    gradient[n, 1, 1] += yy
    gradient[n, 2, 2] += zz
    gradient[n, 0, 1] += xy
    gradient[n, 1, 0] += xy
    gradient[n, 0, 2] += xz
    gradient[n, 2, 0] += xz
    gradient[n, 1, 2] += yz
    gradient[n, 2, 1] += yz
