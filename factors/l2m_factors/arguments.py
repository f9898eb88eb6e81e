"""Arrays that a factor keeps: copied and checked, once, when it is made.

Kept as it came, an array changes the factor when its owner writes into it, as where one buffer
takes all readings; of another shape it may be spread over all readings; and one number that is not
finite switches off a whole optimisation.
"""

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.field_map import FloatArray


def numbers(name: str, values: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return a copy of finite numbers.

    Parameters
    ----------
    name
        Of the array, for the error.
    values
        The numbers.
    shape
        That they must have.

    Raises
    ------
    ValueError
        They have another shape, or one is not finite; the line says which.
    """
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: not an array of numbers; needed is shape {shape}") from error
    of_shape(name, array, shape)
    finite = np.isfinite(array)
    if not finite.all():
        row = int(np.argwhere(~finite)[0, 0])
        raise ValueError(f"{name}: row {row} is not finite; leave it out or give numbers")
    return array


def of_shape(name: str, values: npt.ArrayLike, shape: tuple[int, ...]) -> None:
    """Raise a ValueError for an array of another shape, of which no copy is needed."""
    if np.shape(values) != shape:
        raise ValueError(f"{name}: of shape {np.shape(values)}; needed is {shape}")


def indices(name: str, values: npt.ArrayLike, count: int | None = None) -> npt.NDArray[np.int64]:
    """Return a copy of integers from 0.

    Parameters
    ----------
    name
        Of the array, for the error.
    values
        The integers, shape (n,).
    count
        How many are needed; any number if absent.

    Raises
    ------
    ValueError
        They are not that many, or one is negative or no integer, such as of a mask.
    """
    array = np.asarray(values)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        needed = "integers of shape (n,); np.flatnonzero makes them of a mask"
        raise ValueError(f"{name}: {array.dtype} of shape {array.shape}; needed are {needed}")
    if count is not None:
        of_shape(name, array, (count,))
    if array.min(initial=0) < 0:
        raise ValueError(f"{name}: {array.min()} is negative; indices count from 0")
    return array.astype(np.int64)


def covered(what: str, count: int, sensor: npt.NDArray[np.int64]) -> None:
    """Raise a ValueError if readings have a sensor of which there is no calibration or the like."""
    largest = int(sensor.max(initial=-1))
    if largest >= count:
        raise ValueError(f"sensor: {largest}; there are {what} of {count} sensors, from 0")


def index(name: str, value: int, count: int) -> int:
    """Return an index from 0; a ValueError for one that is not below the count."""
    if not 0 <= value < count:
        raise ValueError(f"{name}: {value}; there are {count}, from 0")
    return value


def noise_of(noise: gtsam.noiseModel.Base, size: int) -> gtsam.noiseModel.Base:
    """Return a noise model; a ValueError for one that is not of so many components."""
    if not isinstance(noise, gtsam.noiseModel.Base):
        raise ValueError(f"noise: {noise!r}; needed is a gtsam.noiseModel of dimension {size}")
    if noise.dim() != size:
        raise ValueError(f"noise: of dimension {noise.dim()}; needed is {size}")
    return noise
