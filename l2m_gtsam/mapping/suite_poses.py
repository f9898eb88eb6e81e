r"""What errors of a survey's poses do to the sensors that are calibrated by it.

Readings of a pass share the errors of their poses. Counted as noise of each reading, as the scoring
of ``suite_solver`` has it, they average out along a pass, and sigmas are too small. With J and E
what a unit of the sensors' parameters and of the poses' errors does to the readings, K the
covariance of field and noise, :math:`\Lambda` the prior and Q the variances of the errors, the
estimate has the covariance

.. math::
    A^{-1} + A^{-1} J^T K^{-1} E\, Q\, E^T K^{-1} J A^{-1}, \qquad A = J^T K^{-1} J + \Lambda

The estimate itself stays as it is: such errors have no mean. Their sizes are stated, or those that
make what the sensors leave most likely, as for a map (``maps.harmonic.pose_sizes``).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.mapping.shifts import survey_poses
from l2m_gtsam.mapping.suite_likelihood import WindowSlopes, window_slopes
from l2m_gtsam.mapping.suite_solver import SuiteRound, likeness
from l2m_gtsam.maps.harmonic.pose_sizes import (
    PARTS,
    FoundPoses,
    PoseView,
    gain_as_stated,
    most_likely,
    noise_beside,
)
from l2m_gtsam.maps.survey_poses import SurveyPoses
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.solve.variance_components import WeightSystem


@dataclass(frozen=True)
class PosedRound:
    """A round whose covariance holds errors of poses, and what was found if none were stated."""

    round: SuiteRound
    found: FoundPoses | None = None


@dataclass(frozen=True)
class PosesInWindow:
    """What errors of the poses do to the N readings of a window.

    Attributes
    ----------
    view
        What the readings say of them beside field and sensors.
    effects
        Of a unit of each error in uT, shape (N, 3, q).
    crossed
        ``J^T K^-1 E``, shape (16 S, q).
    """

    view: PoseView
    effects: FloatArray
    crossed: FloatArray


@dataclass(frozen=True)
class PosedSurvey:
    """The windows of a survey at the solution, with the poses that they were taken at.

    Attributes
    ----------
    slopes, poses
        Of each window.
    prior
        Information about the sensors that is assumed, shape (16 S, 16 S).
    """

    last: SuiteRound
    slopes: tuple[WindowSlopes, ...]
    poses: tuple[SurveyPoses, ...]
    prior: FloatArray

    @property
    def information(self) -> FloatArray:
        """About the sensors, without what is assumed, shape (16 S, 16 S)."""
        return np.asarray(sum(each.information(each.slopes) for each in self.slopes))

    def seen(self, sizes: FloatArray | None, lasting_s: float) -> list[PosesInWindow]:
        """Return what errors do that last so long, by their sizes in rad and m, shape (6,).

        A unit is one of these, or where they are absent what was stated.
        """
        known = cho_factor(self.information + self.prior)
        found = []
        for slopes, poses in zip(self.slopes, self.poses, strict=True):
            lasting = replace(poses, sizes=sizes, lasting_s=lasting_s)
            effects = lasting.knots(np.arange(len(slopes.points)), slopes.gradient)
            E, part = effects.white, PARTS[effects.part]
            count = slopes.slopes.shape[2]
            every = slopes.information(np.concatenate([slopes.slopes, E], axis=2))
            crossed = every[:count, count:]
            left = every[count:, count:] - crossed.T @ cho_solve(known, crossed)
            pull = np.einsum("nik,ni->k", E, slopes.residual) / slopes.noise**2
            system = WeightSystem(0.5 * (left + left.T), pull)
            squares = float((slopes.residual**2).sum()) / slopes.noise**2
            variance = np.square(E).mean(axis=(0, 1))
            by_unit = np.array([variance[part == each].sum() for each in np.unique(PARTS)])
            found.append(PosesInWindow(PoseView(system, part, squares, by_unit), E, crossed))
        return found

    def views(self, unit: FloatArray, lasting_s: float) -> list[PoseView]:
        """Return what each window says of errors that last so long, by a unit of each, (6,)."""
        return [each.view for each in self.seen(unit, lasting_s)]


def with_pose_errors(
    last: SuiteRound, trajectory: Trajectory, options: PoseNoiseOptions, prior: FloatArray
) -> PosedRound:
    """Return the last round with a covariance that holds errors of the poses; as it is without any.

    Parameters
    ----------
    last
        Sensors and windows.
    trajectory
        The poses of the survey.
    options
        How wrong they are. Where nothing is stated it is looked for in the readings.
    prior
        Information about the sensors that is assumed, shape (16 S, 16 S).
    """
    windows = last.windows
    slopes = [window_slopes(each, last.sensors, windows.prior) for each in windows.parts]
    poses = [
        survey_poses(trajectory, part.readings, each.undone.points, each.undone.field, options)
        for part, each in zip(windows.parts, slopes, strict=True)
    ]
    known = [each for each in poses if each is not None]
    if len(known) < len(slopes):
        return PosedRound(last)
    survey = PosedSurvey(last, tuple(slopes), tuple(known), prior)
    if known[0].stated:
        seen = survey.seen(None, known[0].lasting_s)
        # Errors that every pose has of its own are noise of each reading, which is learnt.
        lasting = known[0].duration_stated or gain_as_stated([each.view for each in seen]) > 0
        return PosedRound(widened(survey, seen) if lasting else last)
    found = most_likely(survey.views, last.windows.prior.noise)
    if found is None:
        return PosedRound(last)
    return PosedRound(widened(survey, survey.seen(found.sizes, found.lasting_s)), found)


def widened(survey: PosedSurvey, seen: Sequence[PosesInWindow]) -> SuiteRound:
    """Return the round with a covariance that holds errors whose size is their unit."""
    last, left, noise = survey.last, [], noise_beside([each.view for each in seen])
    for slopes, each in zip(survey.slopes, seen, strict=True):
        unit = np.ones(len(each.view.part))
        likeliest = each.view.system.whiter(noise).fit(unit).rest
        left.append(slopes.residual - slopes.beside_field(each.effects @ likeliest))
    # What is alike beyond that, as of waves that are left out.
    alike = noise * likeness(last.windows, left)
    covariance = np.linalg.inv(survey.information / alike + survey.prior)
    shared = sum(each.crossed @ each.crossed.T for each in seen) / alike**2
    return replace(last, covariance=np.asarray(covariance + covariance @ shared @ covariance))
