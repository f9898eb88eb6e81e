"""Where the variances of a calibration come from: all causes together are all of it."""

import numpy as np
import pytest

from l2m_gtsam.qa.verdict.uncertainty import shares_in_words, what_helps
from l2m_gtsam.records.error_budget import ErrorCause, VarianceShare
from l2m_gtsam.studies.troubles.options import Trouble
from tests.drives.troubled import drive


def shares(trouble: Trouble, sensor: int = 0) -> dict[ErrorCause, VarianceShare]:
    found = drive(trouble)[0].result.sensors[sensor].variance_shares
    return {each.cause: each for each in found}


@pytest.mark.parametrize("trouble", [Trouble.CLEAN, Trouble.SUITE, Trouble.POSES, Trouble.DRIFT])
def test_they_add_to_one(trouble: Trouble) -> None:
    for sensor in (0, 1):
        found = shares(trouble, sensor).values()
        for of in ("t", "C", "H"):
            # Shares below 1e-3 are not listed, of up to four causes.
            assert sum(getattr(each, of) for each in found) == pytest.approx(1, abs=4e-3)
        assert all(min(each.t, each.C, each.H) >= 0 for each in found)


def test_a_clean_drive_has_noise_map_and_what_bend_is_not_seen() -> None:
    found = shares(Trouble.CLEAN)
    expected = {ErrorCause.NOISE, ErrorCause.MAP, ErrorCause.WARP}
    assert expected <= set(found) <= expected | {ErrorCause.PRIORS}
    # It may cost 10 % of a clean drive's precision: sigmas that grow by no more.
    assert max(found[ErrorCause.WARP].t, found[ErrorCause.WARP].H) < 1 - 1 / 1.1**2


@pytest.mark.parametrize(
    ("trouble", "cause", "of", "least"),
    [
        (Trouble.POSES, ErrorCause.POSES, "t", 0.2),
        # Three sensors, 3 mm off each: 3 / sqrt(3) mm of the 6 mm of t, in squares.
        (Trouble.SUITE, ErrorCause.SUITE, "t", 0.08),
        (Trouble.DRIFT, ErrorCause.WANDER, "H", 0.2),
    ],
)
def test_a_trouble_is_where_its_uncertainty_comes_from(
    trouble: Trouble, cause: ErrorCause, of: str, least: float
) -> None:
    found = shares(trouble)
    assert getattr(found[cause], of) > least
    assert cause not in shares(Trouble.CLEAN)


def test_words_name_the_largest_first() -> None:
    found = (
        VarianceShare(ErrorCause.NOISE, 0.3, 0.6, 0.1),
        VarianceShare(ErrorCause.MAP, 0.7, 0.395, 0.9),
        VarianceShare(ErrorCause.PRIORS, 0.0, 0.005, 0.0),
    )
    assert shares_in_words(found, "t") == "map 70%, noise 30%"
    assert shares_in_words(found, "C") == "noise 60%, map 40%"
    assert "denser survey" in what_helps(found)
    assert np.isclose(sum(each.C for each in found), 1)
