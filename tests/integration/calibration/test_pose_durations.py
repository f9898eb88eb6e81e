"""How long errors of poses last is found from what readings of different sensors share."""

import numpy as np
import pytest

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.calibrate import calibrated
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.error_budget import DurationSource
from l2m_gtsam.studies.troubles.drives import troubled_drive
from l2m_gtsam.studies.troubles.options import Trouble
from tests.drives.troubled import DRIVE, OPTIONS, hall, starts

READINGS = 1600  # of each sensor


def result(
    lasting_s: float, stated_s: float | None = None, readings: int = READINGS
) -> CalibrationResult:
    """Return the calibration of a drive whose poses are wrong for so long, of stated size."""
    poses = PoseNoiseOptions(
        position_m=OPTIONS.pose_m, rotation_deg=OPTIONS.pose_deg, correlation_s=stated_s
    )
    options = OPTIONS.model_copy(update={"pose_s": lasting_s, "readings": readings})
    recording, truth = troubled_drive(options, hall(Trouble.CLEAN), Trouble.POSES, DRIVE)
    chosen = CalibrationOptions(start=starts(truth), solve=OneKeyOptions(pose_noise=poses))
    return calibrated(recording, hall(Trouble.CLEAN).field_map, chosen).result


@pytest.mark.parametrize("lasting_s", [0.1, 5.0])
def test_the_duration_is_found(lasting_s: float) -> None:
    found = result(lasting_s).pose_duration
    assert found is not None
    assert found.source is DurationSource.FOUND
    # A drive of some minutes has some ten errors of the longer one, each known to a third of its
    # square: a factor of two either way is four sigmas of the duration.
    assert 0.5 < found.seconds / lasting_s < 2.0


def test_what_is_given_counts_and_too_few_readings_tell_nothing() -> None:
    given = result(2.0, stated_s=3.0, readings=OPTIONS.readings).pose_duration
    assert given is not None
    assert (given.seconds, given.source) == (3.0, DurationSource.GIVEN)
    few = result(5.0, readings=OPTIONS.readings).pose_duration
    assert few is not None
    assert few.source is DurationSource.ASSUMED


def test_between_two_poses_readings_have_errors_of_both() -> None:
    recording, _ = troubled_drive(OPTIONS, hall(Trouble.CLEAN), Trouble.POSES, DRIVE)
    between_s = 1e-9 * np.median(np.diff(recording.trajectory.stamp_ns))
    own = result(2.0, stated_s=0.0, readings=OPTIONS.readings).pose_duration
    assert own is not None
    assert own.seconds == pytest.approx(between_s / 2)
