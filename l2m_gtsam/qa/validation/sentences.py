"""A change of a calibration in words."""

import numpy as np

from l2m_gtsam.qa.options import Limit, ValidationOptions
from l2m_gtsam.records.validation import Change, Part

NAMES = {
    Part.PLACE: "its place t",
    Part.ROTATION: "its rotation",
    Part.GAINS: "the gains of its axes (C)",
    Part.ANGLES: "the angles between its axes (C)",
    Part.OFFSET: "its offset H",
    Part.CLOCK: "its clock",
}
# Factor from the units of ``Change``, unit, digits of its parts, and along what they are.
SHOWN = {
    Part.PLACE: (1e3, "mm", 1, " along the lidar's x, y, z"),
    Part.ROTATION: (1.0, "°", 2, " about its own x, y, z"),
    Part.GAINS: (1e2, "%", 2, " of its x, y, z"),
    Part.ANGLES: (1.0, "°", 2, " less between x y, y z, z x"),
    Part.OFFSET: (1.0, "µT", 2, " along its x, y, z"),
    Part.CLOCK: (1e3, "ms", 1, ""),
}
MEANINGS = {
    Part.PLACE: "it was moved, or its mount gave way",
    Part.ROTATION: "it was turned, or its mount gave way",
    Part.GAINS: "its driver scales otherwise, or soft iron near it has changed",
    Part.ANGLES: "soft iron near it has changed",
    Part.OFFSET: "something magnetic on the vehicle was added, removed or magnetised",
    Part.CLOCK: "its stamps are late or early in another way than before",
}


def limits_of(options: ValidationOptions) -> dict[Part, Limit]:
    """Return from where on a change of each part is worth a warning or a failure."""
    return {
        Part.PLACE: options.place_m,
        Part.ROTATION: options.rotation_deg,
        Part.GAINS: options.gain,
        Part.ANGLES: options.angle_deg,
        Part.OFFSET: options.offset_ut,
        Part.CLOCK: options.clock_s,
    }


def amount(part: Part, size: float) -> str:
    """Return a size with its unit."""
    factor, unit, _, _ = SHOWN[part]
    value = factor * size
    number = f"{value:.2g}" if value < 10 else f"{value:.0f}"
    return f"{number}{'' if unit == '°' else ' '}{unit}"


def by_how_much(change: Change) -> str:
    """Return size, parts and sigmas of a change."""
    factor, unit, digits, along = SHOWN[change.part]
    space = "" if unit == "°" else " "
    parts = ", ".join(
        f"{factor * value:.{digits}f} ± {factor * sigma:.{digits}f}"
        if np.isfinite(value) and np.isfinite(sigma)
        else "unknown"
        for value, sigma in zip(change.change, change.sigma, strict=True)
    )
    if len(change.change) == 1:
        return f"{parts}{space}{unit}"
    return f"{amount(change.part, change.size)}: ({parts}){space}{unit}{along}"
