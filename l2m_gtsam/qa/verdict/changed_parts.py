"""Parts of a calibration that changed, in words: what, by how much, and what may have done it."""

from l2m_gtsam.qa.options import Limit, QaOptions, ValidationOptions
from l2m_gtsam.records.validation import CalibrationChange, CalibrationPart
from l2m_gtsam.records.verdict import Level, Reason
from l2m_gtsam.text import in_unit, significant, with_sigma

NAMES = {
    CalibrationPart.PLACE: "its place t",
    CalibrationPart.ROTATION: "its rotation",
    CalibrationPart.GAINS: "the gains of its axes (C)",
    CalibrationPart.ANGLES: "the angles between its axes (C)",
    CalibrationPart.OFFSET: "its offset H",
    CalibrationPart.CLOCK: "its clock",
}
# Factor from the units of ``CalibrationChange``, unit, and axes of its parts.
SHOWN = {
    CalibrationPart.PLACE: (1e3, "mm", " along the lidar's x, y, z"),
    CalibrationPart.ROTATION: (1.0, "°", " about its own x, y, z"),
    CalibrationPart.GAINS: (1e2, "%", " of its x, y, z"),
    CalibrationPart.ANGLES: (1.0, "°", " less between x y, y z, z x"),
    CalibrationPart.OFFSET: (1.0, "µT", " along its x, y, z"),
    CalibrationPart.CLOCK: (1e3, "ms", ""),
}
MEANINGS = {
    CalibrationPart.PLACE: "it was moved, or its mount gave way",
    CalibrationPart.ROTATION: "it was turned, or its mount gave way",
    CalibrationPart.GAINS: "its driver scales otherwise, or soft iron near it has changed",
    CalibrationPart.ANGLES: "soft iron near it has changed",
    CalibrationPart.OFFSET: "something magnetic on the vehicle was added, removed or magnetised",
    CalibrationPart.CLOCK: "its stamps have another delay than before",
}


def change_reason(
    change: CalibrationChange, options: QaOptions, text: str, doubt: str = ""
) -> Reason:
    """Return a change as a reason; a negligible one is only a note."""
    level = limits_of(options.validation)[change.part].level(change.size)
    several = change.part in (CalibrationPart.GAINS, CalibrationPart.ANGLES)
    s, has = ("", "have") if several else ("s", "has")
    what = text.format(name=NAMES[change.part], s=s, has=has, amount=by_how_much(change))
    what = what[0].upper() + what[1:]
    if level is Level.PASS:
        return Reason(level, f"{what}: significant but negligible.")
    return Reason(level, f"{what}: {MEANINGS[change.part]}.{doubt}")


def limits_of(options: ValidationOptions) -> dict[CalibrationPart, Limit]:
    """Return from where on a change of each part is worth a warning or a failure."""
    return {
        CalibrationPart.PLACE: options.place_m,
        CalibrationPart.ROTATION: options.rotation_deg,
        CalibrationPart.GAINS: options.gain,
        CalibrationPart.ANGLES: options.angle_deg,
        CalibrationPart.OFFSET: options.offset_ut,
        CalibrationPart.CLOCK: options.clock_s,
    }


def amount(part: CalibrationPart, size: float) -> str:
    """Return a size with its unit."""
    factor, unit, _ = SHOWN[part]
    return in_unit(significant(factor * size, 2), unit)


def by_how_much(change: CalibrationChange) -> str:
    """Return size, parts and sigmas of a change."""
    return f"{size_and_parts(change)}{SHOWN[change.part][2]}"


def size_and_parts(change: CalibrationChange) -> str:
    """Return size, parts and sigmas of a change, without the axes that they are along."""
    factor, unit, _ = SHOWN[change.part]
    parts = ", ".join(
        with_sigma(factor * value, factor * sigma)
        for value, sigma in zip(change.change, change.sigma, strict=True)
    )
    if len(change.change) == 1:
        return in_unit(parts, unit)
    return f"{amount(change.part, change.size)}: {in_unit(f'({parts})', unit)}"
