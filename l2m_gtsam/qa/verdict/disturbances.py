"""What is said of a process that disturbed a drive."""

from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.disturbance import Disturbance, DisturbanceKind
from l2m_gtsam.records.variance_shares import ErrorCause
from l2m_gtsam.records.verdict import Level, Reason

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
    "walk_ut": (1.0, "{:.2g} µT from the start of the drive to its end"),
    "noise_ut": (1.0, "{:.2g} µT for a time"),
}


CAUSES = {
    DisturbanceKind.WANDER: ErrorCause.WANDER,
    DisturbanceKind.POSES: ErrorCause.POSES,
    DisturbanceKind.FIELD: ErrorCause.FIELD,
    DisturbanceKind.WARP: ErrorCause.WARP,
}
MATTERS = 0.1  # of a variance: what has less of it adds 5 % to a sigma at most


def disturbance_reasons(result: CalibrationResult) -> list[Reason]:
    """Return what disturbed a drive: a warning where it has a share in what is not known."""
    reasons = []
    for found in result.disturbances:
        level = Level.WARN if _share(found, result) > MATTERS else Level.PASS
        reasons.append(Reason(level, disturbance_sentence(found)))
    return reasons


def _share(found: Disturbance, result: CalibrationResult) -> float:
    """Return the largest share of a process in a variance of t, C or H; all, where none is told."""
    sensors = [each for each in result.sensors if found.sensor in (None, each.sensor)]
    if not any(each.variance_shares for each in sensors):
        return 1.0
    return max(
        (
            max(share.t, share.C, share.H)
            for each in sensors
            for share in each.variance_shares
            if share.cause is CAUSES[found.kind]
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
                f"Poses are wrong by about {size}, by the readings themselves. Sigmas hold it; "
                "state the errors of your poses (calibration.solve.pose_noise), or use better "
                "ones."
            )
        case DisturbanceKind.FIELD:
            return (
                f"The field differs from the map's by {size}, for all sensors alike: steel or "
                "currents near by changed, or the survey missed what is along the way. Sigmas "
                "hold it; survey more densely, or again."
            )
        case DisturbanceKind.WARP:
            return (
                f"The frame of the drive is bent against the map's by about {size}. Sigmas hold "
                "it; use poses on the same point cloud for survey and drive."
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
