r"""What the stated errors of a survey's sensors are, as the survey itself shows them.

Errors of several sensors, or of one under several headings, make readings of one place differ. A
prior that is learnt from such readings is rougher, and its noise larger, than those of the field,
and sigmas that follow from both hold neither. With the information I and the pull u of the errors,
the field taken out (see ``suite_sizes``), and their stated covariance P,

.. math::
    \hat\eta = K u, \qquad K = \Pi (1 + P I)^{-1} P, \qquad
    P' = (1 - K I) P (1 - K I)^T + K I K^T

Readings are corrected by the mean, and the map is learnt anew; P' are the errors that are left, in
all readings alike. The tiles' posterior is that for given errors, so that both together are the
joint posterior.

Only C and H as they differ between sensors, and H as it shows under several headings, are
corrected: the projection :math:`\Pi`. Any prior of a field finds a common C that makes the field
smaller more likely, and exact sensors pull at their places, too (see ``suite_sizes``). These keep
their covariance and are considered (Schmidt 1966).
"""

from dataclasses import replace

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions, Learnt
from l2m_gtsam.maps.harmonic.structure import Sources
from l2m_gtsam.maps.harmonic.suite_sizes import JUDGED, differences, survey_view
from l2m_gtsam.maps.harmonic.teaching import learn_map
from l2m_gtsam.maps.harmonic.tiles import Tiles
from l2m_gtsam.maps.suite_errors import FoundErrors, SuiteErrors
from l2m_gtsam.maps.training import TrainingSet, cubes_of
from l2m_gtsam.solve.variance_components import WeightSystem

# The first map takes the errors for noise and short waves; corrected by half of what they are, the
# second shows them as they are.
PASSES = 2


def with_errors_found(
    learnt: Learnt,
    raw: TrainingSet,
    suite: SuiteErrors,
    sources: Sources,
    options: HarmonicOptions,
) -> Learnt:
    """Return what readings teach without the errors of their sensors that they show.

    Parameters
    ----------
    learnt
        What the readings teach as they were taken; what speaks against the survey stays.
    raw
        These readings, not merged.
    suite
        What errors of the sensors do to them, with the covariance stated.
    sources
        Candidate positions of steel, map frame, metres.
    options
        Of the map.
    """
    owner, doubts = cubes_of(raw.points, options.merge), learnt.origin.survey
    averaged = suite.averaged(owner, raw.weight)
    mean, every = np.zeros(len(suite.covariance)), np.eye(len(suite.covariance))
    for _ in range(PASSES):
        seen = survey_view(learnt, Tiles(learnt), averaged, every).system
        # The pull of readings as they were taken.
        whole = replace(seen, pull=seen.pull + seen.information @ mean)
        mean, left = considered(whole, suite.covariance, shown(len(suite.sensors)))
        found = FoundErrors(mean, suite.covariance)
        corrected = replace(suite, covariance=left, found=found)
        learnt = learn_map(replace(raw, field=corrected.corrected(raw.field)), sources, options)
    origin = replace(learnt.origin, survey=doubts)
    return replace(learnt, origin=origin, suite=corrected.averaged(owner, raw.weight))


def shown(sensors: int) -> FloatArray:
    """Return the projection on what readings of so many sensors show, shape (16 S, 16 S)."""
    turned, part = differences(sensors)
    own = turned[:, np.isin(part, JUDGED)]
    return np.asarray(own @ own.T)


def considered(
    seen: WeightSystem, P: FloatArray, projection: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of errors of which some are estimated, the others considered.

    Parameters
    ----------
    seen
        What readings say of all n errors.
    P
        Covariance before, shape (n, n).
    projection
        On those that are estimated, shape (n, n).
    """
    information, every = seen.information, np.eye(len(P))
    gain = projection @ np.linalg.solve(every + P @ information, P)
    kept = every - gain @ information
    left = kept @ P @ kept.T + gain @ information @ gain.T
    return gain @ seen.pull, 0.5 * (left + left.T)
