"""A recording as a solve takes it: readings with all that is known of their poses."""

from dataclasses import replace

from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import Recording, Synchronised
from l2m_gtsam.recording.joining import joined_readings
from l2m_gtsam.recording.pose_noise import pose_roots
from l2m_gtsam.recording.regressors import check_changes, with_regressors
from l2m_gtsam.recording.sync import synchronise
from l2m_gtsam.solve.explain import movement


def prepare(recording: Recording, options: CalibrationOptions) -> Synchronised:
    """Return the readings that take part, their poses, how these move and how wrong they are.

    Of a vehicle that stands still, velocities are the noise of its poses: they are left out, as
    they are where clocks are known to agree. Drives that were joined are prepared one by one: a
    place that was read in one drive is read anew in the next.

    Raises
    ------
    SyncError
        Readings and poses or recorded numbers of a drive do not overlap, or a number never changes.
    """
    parts = [_prepared(drive, options) for drive in recording.parts]
    whole = joined_readings(parts, recording)
    check_changes(whole.readings, recording.scalars)
    return whole


def _prepared(recording: Recording, options: CalibrationOptions) -> Synchronised:
    """Return the same for a single drive."""
    largest, poses = options.solve.largest_offset_s, recording.trajectory
    synchronised = synchronise(recording, options.sync, largest)
    synchronised = with_regressors(synchronised, recording.scalars, options.regressors)
    readings = synchronised.readings
    still = movement(poses.R, poses.p).at_rest
    readings = replace(
        readings,
        motion=None if still or not largest else readings.motion,
        pose_root=pose_roots(poses, readings.stamp_ns, options.solve.pose_noise),
    )
    return replace(synchronised, readings=readings)
