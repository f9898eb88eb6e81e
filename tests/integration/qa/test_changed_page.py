"""What a report shows of steel that came, went or was moved: sentences, picture and tables."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from l2m_gtsam.calibration.calibrate import calibrated
from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.evaluate import evaluate
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.calibration_page import calibration_page
from l2m_gtsam.qa.report.figures.changes import added_field
from l2m_gtsam.qa.verdict.places import cause_in_short, source_sentence, stretch_head, stretch_tail
from l2m_gtsam.records.calibration import Disagreement, Return
from l2m_gtsam.records.places import Cause, CauseGain, ChangedSource
from tests.drives.verdict import changed_place

PLACE, VEHICLE = CauseGain(Cause.PLACE, 90.0, 2.0), CauseGain(Cause.VEHICLE, 87.0, 2.0)


def source(x: float, half: float = 0.0, *causes: CauseGain) -> ChangedSource:
    return ChangedSource(
        position=np.array([x, -0.01, 0.5]),
        position_sigma=np.array([0.03, 0.04, 0.0]),
        moment=np.array([0.0, 0.0, 12.0]),
        moment_sigma=np.array([0.0, 0.0, 3.0]),
        half_axis=np.array([0.0, 0.0, half]),
        gain=100.0,
        nearest=0.8,
        strongest=4.7,
        passages=2,
        explanations=causes,
    )


FIRST, SECOND = source(1.0, 0.4, PLACE), source(-1.5, 0.01, PLACE, VEHICLE)


def test_a_sentence_tells_where_and_how_much() -> None:
    assert source_sentence(1, FIRST) == (
        "Steel 1 came, went or was moved since the map was surveyed: at (1.000, -0.010, 0.500) "
        "± 0.050 m, 0.8 m long, 12.0 ± 3.0 A m², up to 4.7 µT at the readings. It is taken into "
        "account."
    )


def test_a_tie_is_called_a_tie() -> None:
    """And a bar of 2 cm is told as a point."""
    told = source_sentence(2, SECOND)
    assert "long" not in told
    assert told.endswith(
        "The readings do not show whether the place changed or something on the vehicle was "
        "switched or moved."
    )


def test_a_column_tells_the_cause_in_few_words() -> None:
    told = [cause_in_short(each) for each in (FIRST, SECOND, source(1.0))]
    assert told == ["the place", "the place or the vehicle", "-"]


def stretch(passed_again: Return, *gains: tuple[Cause, float]) -> Disagreement:
    return Disagreement(
        ("a", "b"), 0, 10**9, np.zeros(3), np.ones(3), 1.7, 20, 3.0, passed_again,
        explanations=tuple(CauseGain(cause, gain, 2.0) for cause, gain in gains),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("gains", "head"),
    [
        (((Cause.PLACE, 80.0), (Cause.MOMENT, 20.0)), "The environment has changed since it was"),
        (((Cause.VEHICLE, 80.0), (Cause.PLACE, 20.0)), "Something on the vehicle was switched"),
        (((Cause.SENSOR, 80.0), (Cause.PLACE, 20.0)), "Something at one sensor was switched"),
        (
            ((Cause.MOMENT, 80.0), (Cause.PLACE, 79.0)),
            "Something passed by, or the environment has changed",
        ),
        # No more than by chance: what was read at another time is all that is known.
        (((Cause.SENSOR, -5.0), (Cause.PLACE, -18.0)), "Something passed by"),
        ((), "Something passed by"),
    ],
)
def test_a_stretch_is_named_after_what_explains_its_places(
    gains: tuple[tuple[Cause, float], ...], head: str
) -> None:
    """Whatever was rejected on another passage."""
    found = stretch(Return.AS_MAPPED, *gains)
    assert stretch_head(found).startswith(head)
    known = any(gain > 0 for _, gain in gains)
    assert stretch_tail(found).startswith("What explains" if known else "Passed again the place")


def test_a_drive_feels_what_a_dipole_adds() -> None:
    """0.2 m / r^3 on its axis, 0.1 m / r^3 across it; and nothing between two drives."""
    gap = np.full(3, np.nan)
    path: FloatArray = np.array([[-1.5, -0.01, 2.5], gap, [0.5, -0.01, 0.5]])
    dipole = replace(SECOND, half_axis=np.zeros(3))
    np.testing.assert_allclose(added_field(path, [dipole]), [0.2 * 12 / 8, 0, 0.1 * 12 / 8])


def pages() -> tuple[str, str]:
    """The report of a drive without and with two changes."""
    drive = changed_place()
    found = calibrated(drive.recording, drive.field_map, drive.options)
    metrics = evaluate(drive.recording, found, drive.options, QaOptions(halves=False))
    changed = replace(found.result, sources=(FIRST, SECOND))
    plain, shown = (
        calibration_page(each, metrics, QaOptions()) for each in (found.result, changed)
    )
    return plain, shown


def test_the_page_shows_what_changed_where() -> None:
    plain, page = pages()
    assert page.count('href="#changes"') == page.count('id="changes"') == 1
    assert page.index('id="changes"') < page.index("Where the sensors are")
    (picture,) = re.findall(r'aria-label="Steel that came, went or was moved: ([^"]*)"', page)
    assert picture == "1 at (1.0, 0.0, 0.5) m, 2 at (-1.5, 0.0, 0.5) m."
    assert "12.0 ± 3.0" in page
    assert "Steel 2 came, went or was moved" in page
    # And a page without changes does not speak of them.
    assert "changes" not in re.findall(r'id="([^"]*)"', plain)


@pytest.mark.parametrize("name", ["position", "position_sigma", "moment", "half_axis"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -1e300])
def test_steel_that_is_nowhere_is_refused(name: str, value: float) -> None:
    """As a file of others may have it: it could not be drawn."""
    changed: Any = {name: np.array([0.0, value, 0.0])}
    with pytest.raises(ValueError, match=f"{name} must be finite numbers"):
        replace(FIRST, **changed)
