"""Where the uncertainty of a calibration comes from: shares of causes, and disturbances."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.error_budget import (
    Disturbance,
    DisturbanceKind,
    DurationSource,
    ErrorCause,
    OffsetJump,
    PoseDuration,
    StatedSize,
    VarianceShare,
)
from l2m_gtsam.records.verdict import Level, Reason
from l2m_gtsam.text import significant, with_sigma

NAMES = {
    ErrorCause.NOISE: "noise",
    ErrorCause.MAP: "map",
    ErrorCause.SUITE: "the survey's sensors",
    ErrorCause.POSES: "poses",
    ErrorCause.WANDER: "wander of H",
    ErrorCause.FIELD: "a field that changed",
    ErrorCause.WARP: "a bent frame",
    ErrorCause.CLOCK: "a clock that drifts",
    ErrorCause.SMOOTHING: "smoothed readings",
    ErrorCause.MOVING_PARTS: "parts that move",
    ErrorCause.CURRENTS: "recorded numbers, jumps of H",
    ErrorCause.PRIORS: "priors",
    ErrorCause.UNMODELLED: "not modelled",
}
REMEDIES = {
    ErrorCause.NOISE: "a longer drive, through more places and headings",
    ErrorCause.MAP: "a denser survey of where the vehicle drives",
    ErrorCause.SUITE: "a survey with calibrated sensors (`l2m map suite`)",
    ErrorCause.POSES: "better poses",
    ErrorCause.WANDER: "a sensor that is warm, away from currents",
    ErrorCause.FIELD: "a new survey, or a drive while nothing near by changes",
    ErrorCause.WARP: "poses on the same point cloud for survey and drive",
    ErrorCause.CLOCK: "one clock for readings and poses",
    ErrorCause.SMOOTHING: "readings without a low-pass filter",
    ErrorCause.MOVING_PARTS: "recorded steering and currents (`bag.regressors`)",
    ErrorCause.CURRENTS: "a drive on which recorded numbers change more, and H does not jump",
    ErrorCause.PRIORS: "a drive that determines what now comes from priors",
    ErrorCause.UNMODELLED: "stated errors of poses and of the survey's sensors",
}
OF_THE_END = "H is stated as at the end of the drive: calibrate again where that does not last."
LISTED = 0.01  # of a variance


STATED = {
    ErrorCause.NOISE: (
        "sigmas stated of the noise of {sensor}",
        "calibration.solve.sensor_noise_ut",
    ),
    ErrorCause.POSES: ("sigmas stated of the poses", "calibration.solve.pose_noise, or the bag"),
}


def stated_wrongly(
    stated: Sequence[StatedSize], sensor: str | None, lasting: PoseDuration | None
) -> list[Reason]:
    """Return what was stated that the readings speak against.

    Parameters
    ----------
    stated
        All that was stated.
    sensor
        Of which sensor; of none, what all of them share.
    lasting
        How long errors of poses last.
    """
    return [
        Reason(Level.WARN, _wrong(each, lasting))
        for each in stated
        if each.sensor == sensor and each.is_wrong and each.cause in STATED
    ]


def _wrong(found: StatedSize, lasting: PoseDuration | None) -> str:
    if found.cause is ErrorCause.POSES and found.sensor is not None:
        return (
            f"{found.sensor} alone shows errors of poses {found.ratio:.1f} times as large as "
            "stated: the other sensors do not. Poses are not the cause but what is next to it, as "
            "iron that moves or a motor's current (bag.regressors)."
        )
    what, where = STATED[found.cause]
    what = what.format(sensor=found.sensor)
    of_poses = found.cause is ErrorCause.POSES and found.ratio < 1
    if of_poses and lasting is not None and lasting.source is DurationSource.ASSUMED:
        # Shorter errors of the stated size have less in common: size and duration look alike.
        return (
            f"The {what} are too large for errors that last {lasting.seconds:g} s, as is assumed: "
            f"the readings show {found.ratio:.2f} times as much, and sigmas are too large. State "
            "how long they last (calibration.solve.pose_noise.correlation_s; 0 if each pose has "
            f"an error of its own), or correct them ({where})."
        )
    if found.ratio > 1:
        counts = "which counts" if found.cause is ErrorCause.NOISE else "and sigmas are too small"
        return (
            f"The {what} are too small: the readings show {found.ratio:.1f} times as much, "
            f"{counts}. Correct them ({where})."
        )
    return (
        f"The {what} are too large: the readings show {found.ratio:.2f} times as much, and sigmas "
        f"are too large. Correct them ({where})."
    )


def shares_in_words(shares: Sequence[VarianceShare], of: str) -> str:
    """Return the shares in the variance of ``t``, ``C`` or ``H``, the largest first."""
    sizes = sorted(((getattr(each, of), NAMES[each.cause]) for each in shares), reverse=True)
    return ", ".join(f"{name} {size:.0%}" for size, name in sizes if size >= LISTED)


def what_helps(shares: Sequence[VarianceShare]) -> str:
    """Return what would lower the variance of t most, or of H where t is not determined."""
    of = "t" if any(each.t for each in shares) else "H"
    return REMEDIES[max(shares, key=lambda each: float(getattr(each, of))).cause]


# Rotations and positions without parts are those of files of before. A file may lack some of these;
# what it has beside them is not shown.
PARTS = {
    "rotation_deg": (1.0, "{:.2f} degrees"),
    "heading_deg": (1.0, "{:.2f} degrees of heading"),
    "tilt_deg": (1.0, "{:.2f} degrees of tilt"),
    "position_m": (1e3, "{:.1f} mm"),
    "floor_m": (1e3, "{:.1f} mm on the floor"),
    "height_m": (1e3, "{:.1f} mm of height"),
    "shift_m": (1e3, "{:.1f} mm"),
    "drift_s": (1e3, "{:.0f} ms from the start of the drive to its end"),
    "smoothing_s": (1e3, "{:.0f} ms"),
    "turning_ut": (1.0, "{:.2g} µT with its turns"),
    "steering_ut": (1.0, "{:.2g} µT with its steering"),
    "speed_ut": (1.0, "{:.2g} µT with its speed"),
    "acceleration_ut": (1.0, "{:.2g} µT with its acceleration"),
    "walk_ut": (1.0, "{:.2g} µT from the start of the drive to its end"),
    "noise_ut": (1.0, "{:.2g} µT for a time"),
}


MATTERS = 0.1  # of a variance: what has less of it adds 5 % to a sigma at most
# What stands for numbers that were not recorded follows them by and large only: what it misses is
# no more than itself. Of a sigma of H, that adds half a percent.
MATTERS_OF_STAND_IN = 0.1


def disturbance_reasons(result: CalibrationResult, sensor: str | None) -> list[Reason]:
    """Return what disturbed a drive: a warning where it has a share in what is not known.

    Parameters
    ----------
    result
        A calibration.
    sensor
        Which was disturbed alone; none for what all of them share.
    """
    reasons = []
    for found in (each for each in result.disturbances if each.sensor == sensor):
        matters = _share(found, result) > MATTERS or _missed(found, result) > MATTERS_OF_STAND_IN
        level = Level.WARN if matters else Level.PASS
        reasons.append(Reason(level, disturbance_sentence(found)))
    return reasons


def jump_reasons(result: CalibrationResult, sensor: str) -> list[Reason]:
    """Return the jumps of H of a sensor: which H a vehicle has from now on is not known."""
    own = [each for each in result.jumps if each.sensor == sensor]
    return [Reason(Level.WARN, f"{jump_sentence(each)} {OF_THE_END}") for each in own]


def jump_sentence(jump: OffsetJump) -> str:
    """Return when H jumped and by how much."""
    size = significant(float(np.linalg.norm(jump.change)), 2)
    parts = ", ".join(map(with_sigma, jump.change, jump.sigma))
    drive = f" of {Path(jump.bag).name}" if jump.bag else ""
    return (
        f"At stamp {1e-9 * jump.stamp_ns:.2f} s{drive}, {jump.seconds:.0f} s after the first "
        f"reading that counts, its offset H jumped by {size} µT: ({parts}) "
        "µT along its x, y, z: something magnetic was laid near it, taken away or switched."
    )


def _missed(found: Disturbance, result: CalibrationResult) -> float:
    """Return what a stand-in for numbers may miss at most, in the least sigma of its sensor's H.

    What it misses is unmodelled: sigmas are without that share here, or it would hide itself.
    """
    if found.kind is not DisturbanceKind.MOVING_PARTS or found.sensor is None:
        return 0.0
    sensor, size = result[found.sensor], np.linalg.norm(list(found.sizes.values()))
    shares = (e.H for e in sensor.variance_shares if e.cause is ErrorCause.UNMODELLED)
    modelled = max(1 - sum(shares), LISTED)
    return float(size / (sensor.H_sigma.min() * np.sqrt(modelled)))


def moves(result: CalibrationResult, sensor: str) -> bool:
    """Return whether H of a sensor was found to follow how the vehicle moves."""
    own = (each for each in result.disturbances if each.sensor == sensor)
    return any(each.kind is DisturbanceKind.MOVING_PARTS for each in own)


def _share(found: Disturbance, result: CalibrationResult) -> float:
    """Return the largest share of a process in a variance of t, C or H; 1 if none is known."""
    sensors = [each for each in result.sensors if found.sensor in (None, each.sensor)]
    if not any(each.variance_shares for each in sensors):
        return 1.0
    cause = ErrorCause(found.kind.value)  # what a process disturbs has its name
    return max(
        (
            max(share.t, share.C, share.H)
            for each in sensors
            for share in each.variance_shares
            if share.cause is cause
        ),
        default=0.0,
    )


def disturbance_sentence(found: Disturbance) -> str:
    """Return what a process is, and its remedy."""
    size = _sizes(found)
    match found.kind:
        case DisturbanceKind.WANDER:
            return (
                f"H of {found.sensor} is not constant: it wanders by {size}. Its sigmas are those "
                "at any moment of the drive; let the sensor warm up, and keep currents away from "
                "it."
            )
        case DisturbanceKind.POSES:
            return (
                f"Poses are wrong by about {size}, by the readings themselves. Sigmas include "
                "it; state the errors of your poses (calibration.solve.pose_noise), or use "
                "better ones."
            )
        case DisturbanceKind.FIELD:
            return (
                f"The field differs from the map's by {size}, for all sensors alike: steel or "
                "currents near by changed, or the survey missed what is along the path. Sigmas "
                "include it; survey more densely, or again."
            )
        case DisturbanceKind.WARP:
            return (
                f"The frame of the drive is bent against the map's by about {size}. Sigmas "
                "include it; use poses on the same point cloud for survey and drive."
            )
        case DisturbanceKind.CLOCK:
            return (
                f"The clock of {found.sensor} drifts against that of the poses by about {size}. "
                "Sigmas include it, and the time offset is that of the middle of the drive; stamp "
                "readings and poses by one clock."
            )
        case DisturbanceKind.SMOOTHING:
            return (
                f"Readings of {found.sensor} are smoothed over about {size} against the poses, as "
                "by a low-pass filter. Sigmas include it, and the time offset is the filter's "
                "mean delay; switch filters off, or drive more slowly."
            )
        case DisturbanceKind.MOVING_PARTS:
            return (
                f"H of {found.sensor} follows how the vehicle moves: by {size}. Sigmas include "
                "it. Iron steers near it, or motors draw currents: record these and name them "
                "(bag.regressors), or mount it further away."
            )


def _sizes(found: Disturbance) -> str:
    """Return the sizes of a process that are above zero."""
    parts = [
        words.format(scale * found.sizes[name])
        for name, (scale, words) in PARTS.items()
        if found.sizes.get(name, 0.0) > 0
    ]
    listed = " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)
    lasting = f", over {found.sizes['lasting_s']:g} s" if "lasting_s" in found.sizes else ""
    return listed + lasting
