"""Sigmas of a survey's sensors that are stated wrongly are noticed, a third and thrice."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import block_diag

from l2m_gtsam.data import FloatArray, KnownSensor
from l2m_gtsam.mapping.map_building import map_recordings
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.maps.build import MapOptions
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.suite_sizes import stated_doubts
from l2m_gtsam.studies.troubles.options import TroublesOptions, World
from l2m_gtsam.studies.troubles.surveys import SurveyDrive, known_suite, place_of, survey_of

# Learnt in three small windows; what stands beside the way has no part in it.
MAP = MapOptions.model_validate(
    {
        "harmonic": {
            "learning": {"windows": 2, "rough": 1, "modes": 150},
            "search": {"rounds": 0},
        }
    }
)
OPTIONS, SEED = TroublesOptions(survey_readings=900, map=MAP), 700


def half_of(survey: SurveyDrive) -> SurveyDrive:
    """Return a survey of half of the floor."""
    rows = survey.p[:, 0] < np.median(survey.p[:, 0])
    return replace(survey, sensor=survey.sensor[rows], R=survey.R[rows], p=survey.p[rows])


@cache
def surveyed(times: float) -> HarmonicMap:
    """Return the map of half a hall whose suite is stated so many times too large.

    With 0 it is not stated at all.
    """
    place, right = place_of(World.HALL, SEED), known_suite(OPTIONS)
    recorded = half_of(survey_of(place, OPTIONS)).recorded(right, place, OPTIONS, off=True)
    stated = {
        name: replace(each, covariance=times**2 * covariance_of(each) if times else None)
        for name, each in right.items()
    }
    chosen = MappingOptions(model=OPTIONS.map)
    found = map_recordings([recorded], stated, chosen, place.built.cloud())
    assert isinstance(found, HarmonicMap)
    return found


def covariance_of(sensor: KnownSensor) -> FloatArray:
    """Return what is stated of a sensor of the studies."""
    assert sensor.covariance is not None
    return sensor.covariance


def doubts(times: float, *, together: bool = False) -> tuple[str, ...]:
    """Return what a map of readings as they were taken says of a suite that is stated so.

    Its sensors may have errors in common.
    """
    found = surveyed(0.0)
    suite = found.learnt.suite
    assert suite is not None
    own = known_suite(OPTIONS)
    covariance = times**2 * block_diag(*(covariance_of(own[each]) for each in suite.sensors))
    if together:  # heights of all sensors
        heights = np.arange(2, len(covariance), 16)
        covariance[np.ix_(heights, heights)] += 1e-6
    return stated_doubts(found.learnt, found.tiles, replace(suite, covariance=covariance))


def test_a_suite_that_is_stated_rightly_is_not_doubted() -> None:
    assert not [each for each in surveyed(1.0).summary.doubts if "sigmas stated" in each]


@pytest.mark.parametrize(("times", "words"), [(1 / 3, "too small"), (3.0, "too large")])
def test_a_suite_that_is_stated_wrongly_is_doubted(times: float, words: str) -> None:
    (found,) = doubts(times)
    assert words in found


def test_the_map_of_a_wrongly_stated_suite_says_so() -> None:
    summary = surveyed(1 / 3).summary
    assert [each for each in summary.doubts if "are too small" in each]


def test_sensors_that_a_survey_calibrated_may_be_better_than_stated() -> None:
    # It may be this very survey, which fits them too well to judge them by.
    assert not doubts(3.0, together=True)
    (found,) = doubts(1 / 3, together=True)
    assert "too small" in found


@pytest.mark.parametrize(
    ("stated", "words"),
    [(("t_sigma",), []), (("t_sigma", "C_sigma", "H_sigma"), ["too small"])],
)
def test_some_sensors_may_be_exact(stated: tuple[str, ...], words: list[str]) -> None:
    """Of two differences between three sensors both hang on the one that is uncertain.

    Places alone are not judged. The other sensors are off, too, and taken for exact: what all three
    differ by is more than the one is stated to be off by.
    """
    found = surveyed(0.0)
    suite = found.learnt.suite
    assert suite is not None
    own = covariance_of(known_suite(OPTIONS)[suite.sensors[0]])
    names = np.array(["t_sigma", "C_sigma", "H_sigma"])
    kept = np.repeat(np.isin(names, stated), (3, 9, 3))
    covariance = np.zeros((16 * len(suite.sensors),) * 2)
    covariance[:15, :15] = own[:15, :15] * np.outer(kept, kept)
    doubts = stated_doubts(found.learnt, found.tiles, replace(suite, covariance=covariance))
    assert [word in told for word, told in zip(words, doubts, strict=True)] == [True] * len(words)
