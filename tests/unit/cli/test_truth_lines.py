"""What is said beside a truth, where a number does not exist."""

from dataclasses import replace

import numpy as np

from l2m_gtsam.cli.tables.calibration import consistency_note
from l2m_gtsam.cli.tables.slam import truth_lines
from l2m_gtsam.data import KnownSensor
from l2m_gtsam.records.calibration import ResidualFigures
from l2m_gtsam.records.localisation_file import PoseErrors, TruthRecord
from tests.drives.calibrations import calibration, open_in, sensor

FIGURES = ResidualFigures(90, np.full(3, 0.2), 0.2, 0.3, 0.5, 0.9, 1.1)
NEAR = PoseErrors(0.01, 0.02, 0.1, 0.2)


def truth_record(odometry: PoseErrors) -> TruthRecord:
    return TruthRecord(9, odometry, NEAR, None, 6.0, 0.05, (), (), (), ())


def test_odometry_that_is_the_truth_has_no_share_that_is_gone() -> None:
    (exact, _) = truth_lines(truth_record(PoseErrors(0.0, 0.0, 0.0, 0.0)))
    assert exact.endswith("localised 10 mm rms, 20 mm at most")
    (less, _) = truth_lines(truth_record(replace(NEAR, rms_m=0.02)))
    assert less.endswith("(50% less)")
    (more, _) = truth_lines(truth_record(replace(NEAR, rms_m=0.008)))
    assert more.endswith("(25% more)")


def test_what_is_not_determined_makes_errors_no_smaller() -> None:
    whole = sensor("whole", residuals=FIGURES)
    part = open_in("part", slice(1, 2), "t_y is open", residuals=FIGURES)
    truth = tuple(
        KnownSensor(each.sensor, each.t_lidar_mag + 3 * whole.t_sigma, each.distortion)
        for each in (whole, part)
    )
    assert "are 3.0 times their sigmas" in consistency_note(calibration(whole, part), truth)
    nowhere = open_in("part", slice(0, 3), "t is open", residuals=FIGURES)
    assert consistency_note(calibration(nowhere), truth[1:]) == "no position was determined"
