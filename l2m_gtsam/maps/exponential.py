"""The exponential function, for loops that a compiler makes vector instructions of."""

from numba import njit

from l2m_gtsam.data import FloatArray, IntArray

FAST = {"reassoc", "contract", "nsz"}
LEAST = -700.0  # an exponent of which float64 still has the power
LOG2_E = 1.4426950408889634
LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
# Added to a number, the lowest bits of its mantissa are the nearest whole number plus the bias of
# float64's exponents; shifted there they are its power of two.
SHIFT = 1.5 * 2.0**52 + 1023
MANTISSA = 52


@njit(cache=True, nogil=True, fastmath={"contract"})
def exponentiate(values: FloatArray, powers: FloatArray, bits: IntArray) -> None:
    """Put exp(v) in the place of each v from ``LEAST`` to 0, to 3e-16 of it.

    It is 2^n exp(r) with n whole and |r| below ln(2) / 2, where a Taylor series is enough. The
    mathematical library's would be called for one value after the other.

    Parameters
    ----------
    values
        Shape (M,).
    powers, bits
        Room for the powers of two, and the same room as whole numbers, shape (M,).
    """
    for j in range(len(values)):
        powers[j] = values[j] * LOG2_E + SHIFT
        n = powers[j] - SHIFT
        r = (values[j] - n * LN2_HIGH) - n * LN2_LOW
        p = 1 / 479001600
        p = p * r + 1 / 39916800
        p = p * r + 1 / 3628800
        p = p * r + 1 / 362880
        p = p * r + 1 / 40320
        p = p * r + 1 / 5040
        p = p * r + 1 / 720
        p = p * r + 1 / 120
        p = p * r + 1 / 24
        p = p * r + 1 / 6
        p = p * r + 1 / 2
        p = p * r + 1
        values[j] = p * r + 1
    for j in range(len(values)):
        bits[j] = bits[j] << MANTISSA
    for j in range(len(values)):
        values[j] *= powers[j]
