"""What is said of a process that disturbed a drive."""

from l2m_gtsam.records.disturbance import Disturbance, DisturbanceKind


def disturbance_sentence(found: Disturbance) -> str:
    """Return what a process is, and its remedy."""
    size = found.sizes
    match found.kind:
        case DisturbanceKind.WANDER:
            return (
                f"H of {found.sensor} is not constant: it wanders by {size['walk_ut']:.2g} uT from "
                f"the start of the drive to its end, beside noise of {size['noise_ut']:.2g} uT "
                "that lasts. Its sigmas are those at any moment of the drive; let the sensor warm "
                "up, and keep currents away from it."
            )
        case DisturbanceKind.POSES:
            return (
                f"Poses are wrong by about {1e3 * size['position_m']:.1f} mm and "
                f"{size['rotation_deg']:.2f} degrees over {size['lasting_s']:g} s, by the readings "
                "themselves. Sigmas hold it; state the errors of your poses "
                "(calibration.solve.pose_noise), or use better ones."
            )
        case DisturbanceKind.FIELD:
            return (
                f"The field differs from the map's for a time, by {size['noise_ut']:.2g} uT and "
                f"{size['walk_ut']:.2g} uT more by the end, for all sensors alike: steel or "
                "currents near by changed, or the survey missed what is along the way. Sigmas "
                "hold it; survey more densely, or again."
            )
        case DisturbanceKind.WARP:
            return (
                f"The frame of the drive is bent against the map's by about "
                f"{1e3 * size['shift_m']:.1f} mm. Sigmas hold it; use poses on the same "
                "point cloud for survey and drive."
            )
