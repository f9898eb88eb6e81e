"""What a solution leaves open, in words, from the readings that it used.

What is open is looked for twice: at the solution, and at ideal sensors where the solve started. An
estimate that nothing holds may run away to where the map seems to hold it; the start has not.

Where readings do not show that the field varies they show no place either. Sigmas are those of the
map's gradient where the solve ended. In a field that is much the same everywhere noise leads it
anywhere, to where the map happens to be steeper, and sigmas are then those of a place that nothing
holds.
"""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.determined import TIME_OFFSET
from l2m_gtsam.calibration.forecast import rank_tests
from l2m_gtsam.calibration.joint import SensorSolution, with_infinities
from l2m_gtsam.calibration.one_key import OneKeySolution
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.solve.chi_square import quantile
from l2m_gtsam.solve.closed_form import left_by_any
from l2m_gtsam.solve.explain import drive_facts, explain, held_offset
from l2m_gtsam.solve.noise import is_chance
from l2m_gtsam.solve.rank import PARAMETERS, Determinacy, RankOptions

AXES = 3
LIMIT = float(quantile(0.999, AXES))  # of what a place explains of noise, so many are below
OF_PLACE = slice(0, 3)
EVEN = (
    "position (t_x, t_y, t_z): a field that is the same everywhere explains the readings as well; "
    "drive where the field varies more"
)


@dataclass(frozen=True)
class Explained:
    """A sensor's solution and in words what it leaves open.

    Attributes
    ----------
    solution
        With infinite variances for all of that.
    words
        A sentence for each reason, with the parameters by name; none if nothing is open.
    held
        Why the time offset is held at zero; empty if it is not.
    from_priors
        What only priors determine, a phrase for each of their kinds.
    """

    solution: SensorSolution
    words: tuple[str, ...]
    held: str
    from_priors: tuple[str, ...]


def explained(
    readings: Readings,
    field_map: QueryableMap,
    t_start: FloatArray,
    solution: OneKeySolution,
    options: OneKeyOptions,
) -> dict[int, Explained]:
    """Return every solved sensor with what its readings leave open.

    Parameters
    ----------
    readings
        All that the solve was given.
    field_map
        The map.
    t_start
        Where each sensor started in the lidar frame in metres, shape (S, 3).
    solution
        What the solve found.
    options
        How it was solved.
    """
    if not solution.solved:
        return {}
    noise, priors = solution.estimate.noise, solution.estimate.priors
    tests = rank_tests(readings, field_map, t_start, noise, options, priors)
    used, explanations = solution.readings.select(solution.used), {}
    for found in solution.solved:
        s, after = found.sensor, found.determinacy
        before, own = tests.get(s, after), used.select(used.sensor == s)
        words = undetermined(before, own, t_start[s], field_map, options.rank)
        if (after.touched & ~before.touched).any():
            words += undetermined(after, own, solution.estimate.t[s], field_map, options.rank)
        open_ = replace(before, offset=after.offset)
        held = not (before.touched | after.touched)[OF_PLACE].any() and not priors.each
        if held and shows_no_place(own, field_map, solution.estimate.t[s]):
            words += (EVEN,)
            open_ = replace(open_, touched=open_.touched | (np.arange(len(PARAMETERS)) < 3))
        covariance = with_infinities(found.joint_covariance, open_)
        found = replace(found, joint_covariance=covariance)
        explanations[s] = Explained(found, words, held_offset(after), from_priors(before, after))
    return explanations


def from_priors(*tests: Determinacy) -> tuple[str, ...]:
    """Return which parameters priors alone determine, or mostly, by any of a sensor's tests."""
    touched = np.any([test.touched for test in tests], axis=0)
    open_ = {PARAMETERS[index] for index in np.flatnonzero(touched)}
    whys = {name: f"mostly {why}" for test in tests for name, why in test.leaning.items()}
    whys |= {name: why for test in tests for name, why in test.borrowed.items()}
    names = [name for name in (*PARAMETERS, TIME_OFFSET) if name in whys and name not in open_]
    groups = {whys[name]: [each for each in names if whys[each] == whys[name]] for name in names}
    return tuple(f"{', '.join(group)} ({why})" for why, group in groups.items())


def undetermined(
    test: Determinacy,
    readings: Readings,
    t_lidar_mag: FloatArray,
    field_map: QueryableMap,
    options: RankOptions,
) -> tuple[str, ...]:
    """Return what the readings of one sensor leave open, a sentence for each reason.

    Parameters
    ----------
    test
        The rank test of the sensor.
    readings
        Those of it that were used.
    t_lidar_mag
        Where it sits in the lidar frame in metres, shape (3,).
    field_map
        The map.
    options
        The scales of the test.
    """
    if not test.names:
        return ()
    R, p = readings.R_map_lidar, readings.p_map_lidar
    field, gradient = field_map.field_and_gradient(np.asarray(R @ t_lidar_mag + p))
    return explain(test, drive_facts(R, p, field, gradient), options)


def shows_no_place(readings: Readings, field_map: QueryableMap, t: FloatArray) -> bool:
    """Return whether a field that is the same everywhere explains readings as well as a place.

    It has to leave noise: where neighbours have much the same left the field varies, and the map is
    of another place.

    Parameters
    ----------
    readings
        Of one sensor, those that were used, in order of time.
    field_map
        The map.
    t
        Where the sensor was found in the lidar frame, metres, shape (3,).
    """
    R, p = readings.R_map_lidar, readings.p_map_lidar
    sample = field_map.query(R @ t + p)
    inside = sample.inside
    if not inside.any():
        return True
    field, z, R = sample.field[inside], readings.field[inside], R[inside]
    by_map = left_by_any(np.einsum("nji,nj->ni", R, field), z)
    left = left_by_any(np.einsum("nji,j->ni", R, field.mean(axis=0)), z)
    # Twice the logarithm of the likelihood ratio, with noise as what the map leaves.
    gain = (np.sum(left**2) - np.sum(by_map**2)) / np.mean(by_map**2)
    return bool(gain < LIMIT) and is_noise(left)


def is_noise(left: FloatArray) -> bool:
    """Return whether neighbours are no more alike than chance makes them, shape (N, 3)."""
    alike = np.sum(left[1:] * left[:-1]) / np.sum(left**2)
    return is_chance(float(alike), left.size)
