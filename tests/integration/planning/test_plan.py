"""The plan is the solve's own covariance, and what it assumes where nothing is said."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.cli.tables.drives import noise_note
from l2m_gtsam.data import FieldSeries, Recording, SourceFile
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.planning.motion import PlanOptions
from l2m_gtsam.planning.plan import assumed_recording, plan
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.records.plan import NoiseSource
from tests.drives.degenerate import STRONG, eight
from tests.worlds.harmonic import PRIOR, fitted_map

PLACE = (0.1, -0.05, 0.05)
GIVEN = OneKeyOptions(sensor_noise_ut=0.1)
SOURCE = SourceFile("drive.bag", "ab12")


@pytest.fixture(scope="module")
def learnt() -> HarmonicMap:
    return fitted_map()


def ideal(field_map: QueryableMap) -> Recording:
    """A small figure of eight; an ideal sensor without noise that sees what the map says."""
    drive = replace(eight(), p=eight().p * [0.35, 0.45, 1.0])
    field, _ = field_map.field_and_gradient(drive.R @ np.array(PLACE) + drive.p)
    reading = np.einsum("nji,nj->ni", drive.R, field)
    return Recording(drive, (FieldSeries("mag", "/m", "m", drive.stamp_ns, reading),), SOURCE)


def options(solve: OneKeyOptions = GIVEN) -> CalibrationOptions:
    return CalibrationOptions(start={"mag": PLACE}, solve=solve)


@pytest.mark.parametrize("kind", list(Uncertainty))
def test_an_ideal_sensor_gets_the_covariance_that_was_planned(
    learnt: HarmonicMap, kind: Uncertainty
) -> None:
    """Nothing differs then but the rounds in which weights settle.

    A frame that may be bent is left out: a plan counts what noise will leave open of it, and these
    readings have none.
    """
    chosen = options(GIVEN.model_copy(update={"uncertainty": kind, "warp_m": 0.0}))
    recording = ideal(learnt.compile())
    before = plan(recording, learnt, chosen, PlanOptions())
    after = calibrate(recording, learnt, chosen)
    assert before.uncertainty is after.uncertainty is kind
    sigma = before["mag"].sigma
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(
        after["mag"].covariance / scale, before["mag"].covariance / scale, atol=5e-3
    )
    np.testing.assert_allclose(
        after["mag"].rotation_covariance, before["mag"].rotation_covariance, rtol=0.02, atol=1e-9
    )


def test_a_plan_counts_what_noise_leaves_open_of_a_bent_frame(learnt: HarmonicMap) -> None:
    recording = ideal(learnt.compile())
    before = plan(recording, learnt, options(), PlanOptions())["mag"].sigma
    after = np.sqrt(np.diag(calibrate(recording, learnt, options())["mag"].covariance))
    # Where nothing of it shows, the solve takes the frame for straight.
    assert (before > 0.99 * after).all()
    assert (before[:3] < 2 * after[:3]).all()


def test_readings_do_not_matter() -> None:
    recording = ideal(STRONG)
    silent = assumed_recording(recording.trajectory, SOURCE, ("mag",), 20.0)
    assert len(silent.series[0]) == len(recording.series[0])
    one, other = (
        plan(each, STRONG, options(), PlanOptions())["mag"] for each in (recording, silent)
    )
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_the_noise_is_given_or_the_maps_or_assumed(learnt: HarmonicMap) -> None:
    recording, open_ = ideal(STRONG), options(OneKeyOptions())
    given = plan(recording, STRONG, options(), PlanOptions())
    assert (given.noise, given.noise_source) == (GIVEN.sensor_noise_ut, NoiseSource.GIVEN)
    of_map = plan(recording, learnt, open_, PlanOptions())
    assert (of_map.noise, of_map.noise_source) == (PRIOR.noise, NoiseSource.MAP)
    assumed = plan(recording, STRONG, open_, PlanOptions(noise_ut=0.7))
    assert (assumed.noise, assumed.noise_source) == (0.7, NoiseSource.ASSUMED)
    assert noise_note(given) == (
        "noise of mag is taken as 0.1 uT: that of `calibration.solve.sensor_noise_ut`"
    )
    assert "that of the survey's sensors" in noise_note(of_map)
    assert "is taken as 0.7 uT: that of `plan.noise_ut`" in noise_note(assumed)
    assert all("state it with `calibration." in noise_note(each) for each in (of_map, assumed))


def test_a_place_for_an_unknown_sensor_is_refused() -> None:
    wrong = CalibrationOptions(start={"compass": PLACE})
    with pytest.raises(CalibrationError, match="no sensor named 'compass'; the recording has mag"):
        plan(ideal(STRONG), STRONG, wrong, PlanOptions())
