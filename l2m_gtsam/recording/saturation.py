"""Readings beyond a magnetometer's range, recognised from the readings alone. Pure.

What exceeds the range of an axis is reported as its largest or smallest value, exactly. A smooth
field that turns back at an extreme is within d of it for a time that goes as sqrt(d), and noise
thins its tail further: of the readings within W of the extreme, at most sqrt(q / W) have the
extreme itself, with q the step of the sensor's digits. More ties than the binomial distribution
gives by chance are a limit. In a calm field coarse digits tie as well, but then whole readings
repeat, all axes at once; beyond a limit the other axes go on.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.special import bdtrc

from l2m_gtsam.data import BoolArray, FloatArray, SaturatedAxis

CHANCE = 1e-10  # of so many ties at an extreme of a sound axis
FEWEST = 3  # ties
STEPS = 4  # of the digits, and this share of the range, whichever is more, is near the extreme
NEAR = 0.05
RESOLVED = 16  # steps: an axis that varies by less does not show where it ends
# Gaps between values are whole numbers of steps to this, as many of them; of gaps of any size one
# in five would be.
OFF_GRID, ON_GRID = 0.1, 0.5
LEAST_SHOWN = 0.01  # share that is written without decimals
REPEATED = 0.1  # share of ties in which all axes repeat, from which on the field is calm


def saturated_axes(field: FloatArray) -> tuple[SaturatedAxis, ...]:
    """Return the limits of range that a sensor's readings show, none if there are none.

    Parameters
    ----------
    field
        Finite readings in order of time, shape (N, 3); at different places, for those of a vehicle
        at rest tie by themselves.
    """
    distinct, found = np.unique(field, axis=0), list[SaturatedAxis]()
    for k, axis in enumerate("xyz"):
        values = np.unique(field[:, k])
        if len(values) <= FEWEST:
            continue
        step, whole = _step(values), float(values[-1] - values[0])
        if whole < RESOLVED * step:
            continue
        near = max(STEPS * step, NEAR * whole)
        for limit in (float(values[0]), float(values[-1])):
            away = np.abs(distinct[:, k] - limit)
            ties, around = int(np.sum(away == 0)), int(np.sum(away <= near))
            # How often so many of those around or more would be at the limit by chance.
            if ties >= FEWEST and bdtrc(ties - 1, around, np.sqrt(step / near)) <= CHANCE:
                at = int(np.sum(field[:, k] == limit))
                found.append(SaturatedAxis(axis, limit, at, len(field)))
    return tuple(each for each in found if not _is_calm(field, each, found))


def _step(values: FloatArray) -> float:
    """Return the step of the digits of an axis; 0 if they are finer than the readings show.

    ``values`` are those that occur, ascending, shape (V,).
    """
    gaps = np.diff(values[1:-1])  # a limit need not be a whole number of steps
    if not len(gaps):
        return float(np.diff(values).min())
    multiples = gaps / gaps.min()
    on_grid = np.abs(multiples - np.round(multiples)) < OFF_GRID
    return float(gaps.min()) if on_grid.mean() >= ON_GRID else 0.0


def _is_calm(field: FloatArray, limit: SaturatedAxis, all_: Sequence[SaturatedAxis]) -> bool:
    """Return whether readings repeat as a whole where an axis is at an extreme.

    Parameters
    ----------
    field
        Readings in order of time, shape (N, 3).
    limit
        The extreme.
    all_
        This and all others that may be limits: an axis at one of them says nothing.
    """
    same, at = field[1:] == field[:-1], np.zeros(field.shape, dtype=np.bool_)
    for each in all_:
        at[:, "xyz".index(each.axis)] |= field[:, "xyz".index(each.axis)] == each.limit
    axis = "xyz".index(limit.axis)
    tied = same[:, axis] & (field[1:, axis] == limit.limit) & ~at[1:].all(axis=1)
    repeated = (same | at[1:])[tied].all(axis=1)
    return bool(len(repeated) and repeated.mean() >= REPEATED)


def is_saturated(field: FloatArray, limits: Iterable[SaturatedAxis]) -> BoolArray:
    """Return which readings, shape (N, 3), have an axis at one of the limits, shape (N,)."""
    beyond = np.zeros(len(field), dtype=np.bool_)
    for each in limits:
        beyond |= field[:, "xyz".index(each.axis)] == each.limit
    return beyond


def limits_together(
    limits: Sequence[tuple[SaturatedAxis, ...]], readings: Sequence[int]
) -> tuple[SaturatedAxis, ...]:
    """Return the limits of a sensor over several drives.

    Parameters
    ----------
    limits
        Of each drive.
    readings
        How many readings of each drive were looked at.
    """
    ties: dict[tuple[str, float], int] = {}
    for each in (each for drive in limits for each in drive):
        ties[each.axis, each.limit] = ties.get((each.axis, each.limit), 0) + each.readings
    return tuple(SaturatedAxis(*key, count, sum(readings)) for key, count in sorted(ties.items()))


def saturation_sentence(limits: Sequence[SaturatedAxis]) -> str:
    """Return in words that the range is exceeded, without a full stop; needs one limit at least."""
    first, *others = limits
    more = "".join(f", {_share(each)} along {each.axis} {each.limit:.4g} µT" for each in others)
    return (
        f"{_share(first)} of its readings along {first.axis} equal the extreme {first.limit:.4g} "
        f"µT{more}: its range is exceeded. They do not count. Choose a larger range, or keep the "
        "vehicle's iron away"
    )


def _share(limit: SaturatedAxis) -> str:
    return f"{limit.share:.0%}" if limit.share >= LEAST_SHOWN else f"{limit.share:.1%}"


def saturation_doubts(
    names: Sequence[str], limits: Sequence[tuple[SaturatedAxis, ...]]
) -> tuple[str, ...]:
    """Return a sentence for each sensor whose range is exceeded, without a full stop.

    Parameters
    ----------
    names, limits
        Of each sensor.
    """
    return tuple(
        f"{name}: {saturation_sentence(each)}"
        for name, each in zip(names, limits, strict=True)
        if each
    )
