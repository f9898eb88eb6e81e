"""The one-key solve beside recorded numbers that may explain part of the readings.

First without them. Then models are compared for each sensor; where one with the numbers is
recommended, their field is taken off its readings and all is solved again from where it was, until
that field does not change any more. What is left of it is a variable of the graph.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from l2m_factors import PoseMotion, field_rate
from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.coverage import Correction
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.one_key import OneKeySolution, solve_one_key
from l2m_gtsam.calibration.priors import NO_PRIORS, Priors
from l2m_gtsam.calibration.trust import FEWEST
from l2m_gtsam.calibration.view import QueryableMap, places_of
from l2m_gtsam.data import FieldSample, FloatArray, IntArray, Readings, Trajectory
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.progress import Progress
from l2m_gtsam.records.sensor_models import ModelComparison, MovingField, Samples
from l2m_gtsam.solve.model_comparison import ModelOptions, compare_models
from l2m_gtsam.solve.robust import Loss, RobustOptions, consistent


def predicted(
    parts: Sequence[Readings], field_map: QueryableMap, estimate: Estimate
) -> list[FieldSample]:
    """Return what a map predicts for readings of one sensor each, at least one, part by part.

    The map is asked once: many places in a tile cost less than few many times.
    """
    if not parts:
        return []
    places = [places_of(part, estimate.t) for part in parts]
    sample = field_map.query(np.concatenate(places))
    ends = np.cumsum([len(place) for place in places])[:-1]
    columns = (sample.field, sample.gradient, sample.variance, sample.inside)
    return [FieldSample(*each) for each in zip(*(np.split(c, ends) for c in columns), strict=True)]


def model_samples(
    readings: Readings, sample: FieldSample, estimate: Estimate, names: tuple[str, ...]
) -> Samples:
    """Return readings of one sensor beside what the map predicts where an estimate puts it.

    Without motion the field's rates are zero, so that there is no model of eddy currents.

    Parameters
    ----------
    readings
        Of one sensor, at least one, in order of time; those outside the map do not count.
    sample
        What the map predicts for them; see ``predicted``.
    estimate
        Of its place and noise.
    names
        Of the readings' recorded numbers.
    """
    t = estimate.t[int(readings.sensor[0])]
    inside = sample.inside
    readings, R_lidar_map = readings.select(inside), readings.R_map_lidar[inside].transpose(0, 2, 1)
    b = np.einsum("nij,nj->ni", R_lidar_map, sample.field[inside])
    slope = R_lidar_map @ sample.gradient[inside] @ readings.R_map_lidar
    q = np.empty((len(b), 0)) if readings.regressors is None else readings.regressors
    return Samples(
        z=readings.field,
        b=b,
        db_dt=_rates(readings, b, slope, t),
        q=q,
        weights=1 / (readings.noise(estimate.noise) ** 2 + sample.variance[inside].mean(axis=1)),
        names=names,
        drive=readings.drive,
    )


def _rates(readings: Readings, b: FloatArray, slope: FloatArray, t: FloatArray) -> FloatArray:
    """Return db/dt in uT/s, shape (N, 3); zero where motion is not known."""
    if readings.motion is None:
        return np.zeros_like(b)
    motion = PoseMotion(readings.motion.twist_lidar, readings.motion.offset)
    return field_rate(b, slope, np.broadcast_to(t, b.shape), motion)


def explicable(samples: Samples, noise: float, options: RobustOptions) -> IntArray:
    """Return which readings one distortion and the recorded numbers explain, shape (n,).

    A solve that does not know of a motor may have rejected what its current explains.

    Parameters
    ----------
    samples
        All readings of a sensor inside the map.
    noise
        Of the sensor, as it counts in the weights, uT.
    options
        Of the loss; a squared one takes all readings.
    """
    if options.loss is Loss.SQUARED or len(samples) < FEWEST:
        return np.arange(len(samples))
    spread = samples.q.std(axis=0)
    columns = np.hstack([samples.b, samples.q / np.where(spread > 0, spread, 1.0)])
    variance = np.maximum(1 / samples.weights - noise**2, 0.0)
    return np.flatnonzero(consistent(columns, samples.z, variance, options.largest))


ROUNDS = 5  # of taking fields off; two or three settle
SETTLED_SIGMAS = 0.1


@dataclass(frozen=True)
class MovingSolution:
    """A solve, and what its readings say of models and of recorded numbers.

    Attributes
    ----------
    solution
        Of the readings without the fields of numbers.
    readings
        All that it was given, without these fields.
    compared
        Models of each solved sensor that has enough readings.
    not_compared
        Why there is no comparison for the other solved ones.
    moving
        Fields of the numbers, for sensors that they act on.
    """

    solution: OneKeySolution
    readings: Readings
    compared: dict[int, ModelComparison]
    not_compared: dict[int, str]
    moving: dict[int, tuple[MovingField, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class MovingProblem:
    """What all rounds have in common.

    Attributes
    ----------
    readings
        As they were read, with recorded numbers.
    names
        Of the K numbers.
    field_map
        The map.
    options, models
        How to solve and how to compare.
    progress
        Called with a stage and the fraction of it that is done.
    trajectory
        The lidar's poses.
    priors
        What is known of the sensors beforehand.
    steps
        Numbers that act on all readings beside the recorded ones, shape (N, J): jumps of H.
    """

    readings: Readings
    names: tuple[str, ...]
    field_map: QueryableMap
    options: OneKeyOptions
    models: ModelOptions
    progress: Progress
    trajectory: Trajectory | None
    priors: Priors = NO_PRIORS
    steps: FloatArray | None = None

    def solved(self, t_start: FloatArray, fields: Mapping[int, Correction]) -> "Round":
        """Solve with the fields of numbers taken off readings, and compare models.

        Parameters
        ----------
        t_start
            Where to start each sensor in the lidar frame in metres, shape (S, 3).
        fields
            What numbers add to the readings of the sensors that they act on.
        """
        given = beside_numbers(without(self.readings, fields), self.steps)
        solution = solve_one_key(
            given,
            self.field_map,
            t_start,
            self.options,
            self.progress,
            self.trajectory,
            self.priors,
        )
        compared, not_compared = self._compared(solution)
        return Round(fields, MovingSolution(solution, given, compared, not_compared))

    def _compared(
        self, solution: OneKeySolution
    ) -> tuple[dict[int, ModelComparison], dict[int, str]]:
        compared, not_compared = {}, {}
        parts = self._parts(solution)
        samples = predicted(list(parts.values()), self.field_map, solution.estimate)
        for (sensor, own), sample in zip(parts.items(), samples, strict=True):
            try:
                compared[sensor] = self._comparison(solution, own, sample)
            except CalibrationError as error:
                not_compared[sensor] = str(error)
        return compared, not_compared

    def _parts(self, solution: OneKeySolution) -> dict[int, Readings]:
        """Return the readings of each solved sensor as they were read, at the solve's poses."""
        whole = replace(
            solution.readings, field=self.readings.field, regressors=self.readings.regressors
        )
        counts = solution.inside if self.names else solution.used
        return {
            found.sensor: whole.select(counts & (whole.sensor == found.sensor))
            for found in solution.solved
        }

    def _comparison(
        self, solution: OneKeySolution, own: Readings, sample: FieldSample
    ) -> ModelComparison:
        """Compare models of a sensor on its readings and what the map predicts for them."""
        samples = model_samples(own, sample, solution.estimate, self.names)
        if self.names:
            noise = float(solution.estimate.noise[int(own.sensor[0])])
            samples = samples[explicable(samples, noise, self.options.robust)]
        return compare_models(samples, self.models)


@dataclass(frozen=True)
class Round:
    """A solve with fields of numbers taken off, and the comparison of models after it.

    Attributes
    ----------
    fields
        What was taken off of the sensors that some act on.
    outcome
        Of the readings without that.
    """

    fields: Mapping[int, Correction]
    outcome: MovingSolution

    def found(self) -> dict[int, Correction]:
        """Return the fields of numbers for all sensors to which they are recommended."""
        left = {each.sensor: each.moving for each in self.outcome.solution.solved}
        return {
            sensor: _total(comparison, self.fields.get(sensor), left[sensor])
            for sensor, comparison in self.outcome.compared.items()
            if comparison.recommended.has_regressors
        }

    def settled(self, found: Mapping[int, Correction]) -> bool:
        """Return whether what was found is what had been taken off."""
        return found.keys() == self.fields.keys() and all(
            (np.abs(each.h - self.fields[s].h) <= SETTLED_SIGMAS * each.sigma).all()
            for s, each in found.items()
        )


def _total(
    comparison: ModelComparison, taken_off: Correction | None, left: Correction | None
) -> Correction:
    """Return what was taken off and what the graph found besides; else what the models say."""
    if taken_off is None or left is None:
        return Correction(comparison.coefficients.h, comparison.sigma.h)
    own = slice(len(taken_off.h))  # jumps of H come after the recorded numbers
    return Correction(taken_off.h + left.h[own], left.sigma[own])


def solve_moving(problem: MovingProblem, t_start: FloatArray) -> MovingSolution:
    """Calibrate all sensors of a batch of readings, and compare models of each.

    Parameters
    ----------
    problem
        What to solve.
    t_start
        Where to start each sensor in the lidar frame in metres, shape (S, 3).
    """
    last = problem.solved(t_start, {})
    found, given_up = last.found(), set[int]()
    for _ in range(ROUNDS):
        if last.settled(found):
            break
        last = problem.solved(_places(last.outcome.solution, t_start), found)
        # A sensor that the numbers turn out not to help is solved without them, for good.
        given_up |= found.keys() - last.found().keys()
        found = {s: each for s, each in last.found().items() if s not in given_up}
    moving = {
        sensor: _named(problem.names, found.get(sensor, taken_off))
        for sensor, taken_off in last.fields.items()
    }
    return replace(last.outcome, moving=moving)


def without(readings: Readings, fields: Mapping[int, Correction]) -> Readings:
    """Return readings without the fields of numbers, and the numbers only where they act."""
    if readings.regressors is None or not fields:
        return replace(readings, regressors=None)
    B, numbers = readings.field.copy(), np.zeros_like(readings.regressors)
    for sensor, each in fields.items():
        rows = readings.rows_of(sensor)
        numbers[rows] = readings.regressors[rows]
        B[rows] -= numbers[rows] @ each.h
    return replace(readings, field=B, regressors=numbers)


def beside_numbers(readings: Readings, steps: FloatArray | None) -> Readings:
    """Return readings with more numbers, shape (N, J), beside those that they have."""
    if steps is None:
        return readings
    own = () if readings.regressors is None else (readings.regressors,)
    return replace(readings, regressors=np.hstack([*own, steps]))


def _places(solution: OneKeySolution, t_start: FloatArray) -> FloatArray:
    """Return where sensors were found, or where they started if they were not, shape (S, 3)."""
    t = t_start.copy()
    for found in solution.solved:
        t[found.sensor] = solution.estimate.t[found.sensor]
    return t


def _named(names: tuple[str, ...], found: Correction) -> tuple[MovingField, ...]:
    return tuple(
        MovingField(name, h, sigma)
        for name, h, sigma in zip(names, found.h, found.sigma, strict=True)
    )
