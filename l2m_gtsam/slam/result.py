"""From a solved drive to its result: figures, verdict, refined calibration."""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.optimise import Ending
from l2m_gtsam.data import Distortion, Trajectory
from l2m_gtsam.geometry import polar_rotation
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.localisation import (
    DriftFigures,
    LocalisationResult,
    LocalisationStatus,
    ScanUse,
    SensorUse,
)
from l2m_gtsam.slam.disturbances import slip_notes
from l2m_gtsam.slam.drive import Drive, KnownSensors, as_pose, stacked
from l2m_gtsam.slam.misfit import begins_elsewhere, fits_decoy_as_well
from l2m_gtsam.slam.pose_graph import PoseGraph
from l2m_gtsam.slam.solution import DriveSolution

# Share of the readings inside the map below which a drive is not localised by it.
LEAST_INSIDE = 0.1
# A map that explains a smaller share of the readings is that of another place: in one that was
# changed here and there more of them fit.
LEAST_EXPLAINED = 0.5
# Of mean squares of whitened components, of readings and of odometry: with free poses readings may
# fit the map of another place, at steps that odometry rules out.
LARGEST_CHI2 = 4.0
# Sigmas of all steps' errors, beyond which odometry turns steadily: once in 370 drives by chance.
TURNS = 3.0


def localisation_result(
    drive: Drive,
    solution: DriveSolution,
    by_scans: PoseGraph,
    refine: CalibrationResult | None,
    decoys: Sequence[DriveSolution] = (),
) -> LocalisationResult:
    """Return the result of a localisation.

    Parameters
    ----------
    drive
        The drive before it was solved. Its drift is that of odometry as it was recorded.
    solution
        Solution of its graph.
    by_scans
        Solution of odometry and scans alone.
    refine
        The calibration that was refined; None if it was fixed.
    decoys
        Solutions in decoys of the map, if the misfit test was made.
    """
    alone = drive.as_recorded(drive.jumps).dead_reckoning()
    status, message = _verdict(solution, decoys)
    sensors = replace(solution.drive.sensors, covariance=solution.calibration_covariance)
    steady = drive.without_drift(solution.steady, solution.poses)
    odometry = _trajectory(drive, alone)
    trajectory = replace(_trajectory(drive, solution.poses), covariance=solution.pose_covariance)
    return LocalisationResult(
        status=status,
        message=message,
        trajectory=trajectory,
        odometry=odometry,
        drift=drift_figures(trajectory, odometry),
        sensors=tuple(_use(solution, i) for i in range(len(drive.sensors.names))),
        calibration=None if refine is None else refined(refine, sensors),
        notes=slip_notes(steady, solution.poses, solution.scale_error),
        scans=scan_use(solution, by_scans),
        by_scans=_trajectory(drive, by_scans.poses) if len(by_scans.believed) else None,
        scale=solution.scale,
        turn=solution.turn,
        hints=turning_hints(solution),
    )


def turning_hints(solution: DriveSolution) -> tuple[str, ...]:
    """Return that odometry seems to turn steadily, where its steps err in one direction.

    Nothing where its turning is a variable, or where readings do not tell the heading.
    """
    steps = solution.drive.steps
    if steps.turning is not None or not steps.path[-1]:
        return ()
    R, _ = stacked(solution.poses)
    off = steps.R.transpose(0, 2, 1) @ R[:-1].transpose(0, 2, 1) @ R[1:]
    too_far = -np.einsum("ni,ni->n", steps.up, Rotation.from_matrix(off).as_rotvec()).sum()
    walk = np.einsum("ni,nij,nj->", steps.up, steps.covariance[:, :3, :3], steps.up)
    first, last = solution.drive.start.covariance[:3, :3], solution.pose_covariance[-1, :3, :3]
    ends = steps.up_start @ first @ steps.up_start + steps.up[-1] @ last @ steps.up[-1]
    if abs(too_far) < TURNS * np.sqrt(max(walk, ends)):
        return ()
    per_m = np.rad2deg(too_far) / steps.path[-1]
    text = (
        f"Odometry seems to turn by {abs(per_m):.2g} deg per metre or more too far to the "
        f"{'left' if per_m > 0 else 'right'}, {abs(too_far) / np.sqrt(walk):.1f} times what errors "
        "of its steps come to: stated as `slam.drift.steady_turn_deg_per_m`, that is estimated "
        "with the poses."
    )
    return (text,)


def scan_use(solution: DriveSolution, by_scans: PoseGraph) -> ScanUse | None:
    """Return how many scans were used and how they fit; None where there were none."""
    if not len(by_scans.believed):
        return None
    links, r2 = solution.drive.links, solution.link_squared
    return ScanUse(
        fixes=int(links.in_map.sum()),
        loops=int((~links.in_map).sum()),
        rejected=int((~by_scans.believed).sum()),
        chi2_per_dof=float(r2.mean() / 6) if len(r2) else float("nan"),
    )


def drift_figures(localised: Trajectory, odometry: Trajectory) -> DriftFigures:
    """Return the drift of odometry at the same key poses."""
    apart = np.linalg.norm(odometry.p - localised.p, axis=1)
    turned = Rotation.from_matrix(localised.R[-1].T @ odometry.R[-1]).magnitude()
    return DriftFigures(
        way_m=float(np.linalg.norm(np.diff(localised.p, axis=0), axis=1).sum()),
        end_m=float(apart[-1]),
        end_deg=float(np.rad2deg(turned)),
        largest_m=float(apart.max()),
        rms_m=float(np.sqrt(np.mean(apart**2))),
    )


def refined(calibration: CalibrationResult, sensors: KnownSensors) -> CalibrationResult:
    """Return a calibration with the sensors that a drive refined; the others stay."""
    names = sensors.names
    entries = [
        _refined(entry, sensors, names.index(entry.sensor)) if entry.sensor in names else entry
        for entry in calibration.sensors
    ]
    return replace(calibration, sensors=tuple(entries), disagreements=())


def _refined(entry: SensorCalibration, sensors: KnownSensors, i: int) -> SensorCalibration:
    covariance = sensors.covariance[i]
    distortion = Distortion.from_vector(sensors.distortion[i])
    rotation = polar_rotation(distortion.C, covariance[3:12, 3:12])
    clock = entry.time_offset
    if clock is not None:
        # The clock was no variable: its correlation with the previous estimate does not hold now.
        clock = replace(clock, cross_covariance=np.zeros(15))
    return replace(
        entry,
        message="refined with the poses of a drive",
        t_lidar_mag=sensors.t[i],
        distortion=distortion,
        R_lidar_mag=rotation.R_mag_lidar.T,
        covariance=covariance,
        rotation_covariance=rotation.covariance,
        time_offset=clock,
    )


def _verdict(
    solution: DriveSolution, decoys: Sequence[DriveSolution]
) -> tuple[LocalisationStatus, str]:
    inside, used = solution.prediction.inside, solution.used
    share = float(inside.mean())
    explained = float(used.sum() / max(inside.sum(), 1))
    # Readings near a change are no evidence about the rest of the map.
    judged = float(used.sum() / max((inside & ~solution.near_changes).sum(), 1))
    chi2 = float(solution.squared[used].mean() / 3) if used.any() else np.inf
    explains = f"the map explains {explained:.0%} of the readings"
    if share < LEAST_INSIDE:
        message = (
            f"the map has data for {share:.0%} of the readings: the drive is not in this map, or "
            "does not begin at the given start"
        )
        return LocalisationStatus.OUTSIDE_MAP, message
    if judged < LEAST_EXPLAINED or max(chi2, solution.odometry_chi2) > LARGEST_CHI2:
        noisy = np.isfinite(chi2) and chi2 > LARGEST_CHI2
        left = f", to {chi2:.1f} times the variance of their noise" if noisy else ""
        times = solution.odometry_chi2
        bent = f", and poses contradict odometry by {times:.1f} times its variance"
        message = (
            f"{explains}{left}{bent if times > LARGEST_CHI2 else ''}: another place, a wrong "
            "start, or a wrong calibration"
        )
        return LocalisationStatus.NOT_HERE, message
    if begins_elsewhere(solution):
        off = as_pose(solution.drive.start.T_map_lidar).between(solution.poses[0])
        turned = np.rad2deg(np.linalg.norm(gtsam.Rot3.Logmap(off.rotation())))
        message = (
            f"{explains}, and the drive would begin {np.linalg.norm(off.translation()):.2f} m and "
            f"{turned:.1f}° from the given start: another place, a wrong start, or a wrong "
            "calibration"
        )
        return LocalisationStatus.NOT_HERE, message
    if fits_decoy_as_well(solution, decoys):
        message = (
            f"{explains}, hardly more than when turned by 180 degrees: another place, a wrong "
            "start, or a wrong calibration"
        )
        return LocalisationStatus.NOT_HERE, message
    if solution.ending is not Ending.TOLERANCE:
        return LocalisationStatus.NOT_CONVERGED, solution.ending.value
    return LocalisationStatus.LOCALISED, explains


def _use(solution: DriveSolution, sensor: int) -> SensorUse:
    own = solution.drive.readings.sensor == sensor
    used = own & solution.used
    residual = solution.prediction.residual[used]
    return SensorUse(
        sensor=solution.drive.sensors.names[sensor],
        readings=int(own.sum()),
        outside_map=int((own & ~solution.prediction.inside).sum()),
        rejected=int((own & solution.prediction.inside & ~solution.used).sum()),
        rms=float(np.sqrt(np.mean(residual**2))) if used.any() else float("nan"),
        chi2_per_dof=float(solution.squared[used].mean() / 3) if used.any() else float("nan"),
    )


def _trajectory(drive: Drive, poses: list[gtsam.Pose3]) -> Trajectory:
    return Trajectory(drive.stamp_ns, *stacked(poses), frame="map", child_frame="lidar")
