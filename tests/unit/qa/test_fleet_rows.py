"""Rows of a fleet from calibrations: their numbers, and the gravest reason."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.qa.fleet import sensor_rows
from l2m_gtsam.qa.options import FleetOptions
from l2m_gtsam.qa.report.fleet_page import fleet_page
from l2m_gtsam.records.calibration import ResidualFigures, SensorStatus
from l2m_gtsam.records.fleet import FleetRow
from l2m_gtsam.records.verdict import Level, Reason, SensorVerdict, Verdict
from l2m_gtsam.storage.fleet_table import flat
from tests.drives.calibrations import calibration, open_in, sensor, unsolved

NOTE, DOUBT, GRAVE = (Reason(level, level.upper()) for level in Level)


def verdict(name: str, own: tuple[Reason, ...], shared: tuple[Reason, ...] = ()) -> Verdict:
    return Verdict(Level.PASS, shared, (SensorVerdict(name, Level.PASS, own),))


@pytest.mark.parametrize(
    ("own", "shared", "level", "reason"),
    [
        ((), (), "pass", ""),
        ((NOTE,), (), "pass", ""),
        ((DOUBT, NOTE), (), "warn", "WARN"),
        ((DOUBT,), (GRAVE,), "fail", "FAIL"),
        ((GRAVE,), (DOUBT,), "fail", "FAIL"),
    ],
)
def test_the_gravest_reason_counts(
    own: tuple[Reason, ...], shared: tuple[Reason, ...], level: str, reason: str
) -> None:
    (row,) = sensor_rows(calibration(sensor()), verdict("mag", own, shared))
    assert (row.verdict, row.reason) == (level, reason)


def test_the_sensors_own_verdict_is_kept_beside_that_of_the_drive() -> None:
    """In the table and on the page, where it is better."""
    judged = Verdict.of([DOUBT], [SensorVerdict.of("mag", [NOTE])])
    (found,) = sensor_rows(calibration(sensor()), judged)
    row = FleetRow("truck", "a.bag", "truck/a", "2026-05-01T10:00:00Z", 60.0, found, "")
    assert (flat(row)["verdict"], flat(row)["sensor_verdict"]) == ("warn", "pass")
    assert "sensor: PASS" in fleet_page([row], FleetOptions())
    same = replace(row, sensor=replace(found, own_verdict="warn"))
    assert "sensor: WARN" not in fleet_page([same], FleetOptions())


@given(st.integers(0, 1000))
def test_the_sigma_of_a_length_beside_drawn_ones(seed: int) -> None:
    """To first order, which errors of a percent of the length leave true to a few percent."""
    made = sensor()
    rng = np.random.default_rng(seed)
    drawn = rng.multivariate_normal(made.distortion.H, made.covariance[12:, 12:], 20_000)
    (row,) = sensor_rows(calibration(made), verdict("mag", ()))
    assert row.hard_iron == pytest.approx(np.linalg.norm(made.distortion.H))
    # a standard deviation of 20,000 draws is known to 0.5 %: six of its sigmas
    assert row.hard_iron_sigma == pytest.approx(np.linalg.norm(drawn, axis=1).std(), rel=0.03)


def test_numbers_are_those_of_the_calibration() -> None:
    R = Rotation.from_euler("zyx", [170, 20, -30], degrees=True).as_matrix()
    figures = ResidualFigures(90, np.full(3, 0.2), 0.2, 0.3, 0.5, 0.9, 1.1)
    made = sensor("mag", R, residuals=figures, rejected=10)
    (row,) = sensor_rows(calibration(made), verdict("mag", ()))
    assert Rotation.from_quat(row.quaternion_xyzw).as_matrix() == pytest.approx(R.T, abs=1e-8)
    assert row.t == pytest.approx(made.t_lidar_mag)
    assert row.H_sigma == pytest.approx(made.H_sigma, abs=1e-8)
    assert row.scale == pytest.approx([1, 1, 1])
    assert (row.residual_rms, row.chi2, row.rejected) == (0.2, 1.1, 0.1)


def test_what_is_not_known_is_no_number() -> None:
    """A sensor without readings, and one whose H is open."""
    (row,) = sensor_rows(
        calibration(unsolved("mag", SensorStatus.NO_READINGS, "none")), verdict("mag", (GRAVE,))
    )
    assert np.isnan([*row.t, *row.quaternion_xyzw, row.hard_iron, row.rejected]).all()
    assert np.isinf([*row.t_sigma, row.hard_iron_sigma]).all()
    (row,) = sensor_rows(calibration(open_in("mag", slice(12, 15), "H")), verdict("mag", ()))
    assert np.isinf(row.hard_iron_sigma)
    assert np.isfinite(row.t_sigma).all()
