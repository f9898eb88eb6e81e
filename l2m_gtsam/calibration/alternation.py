"""The paper's two-step loop: a closed form for C and H, then a graph for t, until t settles."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from pydantic import Field

from l2m_factors import T
from l2m_gtsam.calibration.extent import MOST_WEIGHTS
from l2m_gtsam.calibration.factor_graph import Estimate, FactorForm, batch_readings, reading_graph
from l2m_gtsam.calibration.optimise import Optimizer, optimise
from l2m_gtsam.calibration.priors import NO_PRIORS, Priors
from l2m_gtsam.calibration.view import (
    QueryableMap,
    StandIns,
    View,
    glimpse,
    has_left,
    inside_of_each,
    seen_from,
)
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.options import Options
from l2m_gtsam.progress import Progress
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.solve.closed_form import ClosedFormOptions, fit_distortion, ridge_unit, row_weights
from l2m_gtsam.solve.noise import estimate_noise
from l2m_gtsam.solve.rank import RankOptions
from l2m_gtsam.solve.robust import RobustOptions

DISTORTION = 12  # parameters of C and H
# Readings of a sensor without which no step of the alternation is taken: five have 15 components.
FEWEST = 5
# The map's errors change over decimetres: to come near, variances from so near by do, metres.
NEAR_M = 0.03
STANDS_FOR = 4  # readings of the alternation have the variance of the nearest of them
# Weak tie of each T(i) to where it is, for directions without any gradient: metres.
TIE_M = 10.0


class OneKeyOptions(Options):
    """How a calibration is solved."""

    uncertainty: Uncertainty = Uncertainty.FULL
    """`full` (the map's errors are shared by readings near each other, as they are in truth; for
    maps that know them, the harmonic one) or `independent` (each reading has its own; sigmas come
    out up to twenty times too small)."""
    optimizer: Optimizer = Optimizer.LM
    """`lm` (Levenberg-Marquardt) or `gn` (Gauss-Newton, as in the paper)."""
    closed_form: ClosedFormOptions = ClosedFormOptions()
    """The inner step for C and H."""
    factors: FactorForm = FactorForm.BLOCK
    """`block` (one factor per sensor, fast) or `reading` (one per reading)."""
    max_steps: int = Field(default=100, ge=1)
    """Largest number of alternations (the paper's 100)."""
    alternation_readings: int = Field(default=400, ge=5)
    """Readings of each sensor that take part in the alternation, spread evenly over the drive: it
    only has to come near. The joint graph uses all."""
    graph_iterations: int = Field(default=2, ge=1)
    """Linearisations of the translation graph between two closed forms."""
    settled_m: float = Field(default=1e-3, gt=0)
    """The alternation ends when no sensor moves further than this; the joint graph takes over."""
    joint_iterations: int = Field(default=50, ge=1)
    """Largest number of linearisations of a joint optimisation."""
    sensor_noise_ut: float | None = Field(default=None, gt=0)
    """Standard deviation of the sensors' noise; estimated for each sensor if not given."""
    min_readings: int = Field(default=30, ge=5)
    """A sensor with fewer readings inside the map is not solved; five have 15 components."""
    largest_offset_s: float = Field(default=0.25, ge=0, le=10)
    """How far a sensor's clock may be off the lidar's, seconds. The time offset is part of the
    solve where the drive separates it from the position; 0 takes all clocks for one."""
    pose_noise: PoseNoiseOptions = PoseNoiseOptions()
    """How wrong the lidar's poses are. With `uncertainty: independent` each reading has a pose
    error of its own."""
    warp_m: float = Field(default=0.01, ge=0)
    """How far the drive's frame may be bent against the map's, beforehand: standard deviation of
    shifts along the floor in metres. What readings leave possible of it is in the sigmas; 0 where
    both frames are one, as by motion capture."""
    most_weights: int = Field(default=MOST_WEIGHTS, ge=20)
    """Of how many numbers a map's errors may be. Where a drive has more, its tiles with the most
    readings count. Time grows with the cube of this, memory with its square."""
    robust: RobustOptions = RobustOptions()
    """What becomes of readings that the map and one distortion cannot explain."""
    moving_field_ut: float = Field(default=50.0, gt=0)
    """With `bag.regressors`: what a number may add to a sensor, before any reading: a standard
    deviation in microtesla while the number is one standard deviation off its mean."""
    rank: RankOptions = RankOptions()
    """When a direction counts as determined."""

    @property
    def some_readings(self) -> int:
        """Readings of each sensor that are enough to come near."""
        return max(self.alternation_readings, self.min_readings)

    @property
    def fewer_readings(self) -> int:
        """Readings of each sensor where the map's variance is asked for to come near."""
        return max(self.alternation_readings // STANDS_FOR, self.min_readings)


@dataclass(frozen=True)
class Alternated:
    """Where the alternation arrived.

    Attributes
    ----------
    estimate
        All sensors.
    asked
        Where the map was asked last: places of all sensors, metres, shape (S, 3).
    steps
        How many were taken.
    """

    estimate: Estimate
    asked: FloatArray
    steps: int


def start_estimate(
    t_start: FloatArray, options: OneKeyOptions, priors: Priors = NO_PRIORS
) -> Estimate:
    """Return ideal sensors at these positions, shape (S, 3), metres, turned as is known."""
    count = len(t_start)
    ideal = np.tile(np.concatenate([np.eye(3).ravel(), np.zeros(3)]), (count, 1))
    for sensor, R_mag_lidar in priors.mounts().items():
        ideal[sensor, :9] = R_mag_lidar.ravel()
    unknown = options.sensor_noise_ut is None  # then the first closed form replaces it
    noise = np.full(count, 1.0 if unknown else options.sensor_noise_ut)
    return Estimate(t_start, ideal, noise, np.zeros(count), np.zeros(count), priors)


def alternate(
    readings: Readings,
    stand_ins: StandIns,
    field_map: QueryableMap,
    start: Estimate,
    options: OneKeyOptions,
    progress: Progress,
) -> Alternated:
    """Alternate closed form and translation graph until no sensor moves further than settled.

    It only has to come near: `alternation_readings` of each sensor are enough, with the map's
    variance at fewer yet, which is asked for anew only where sensors have moved. A sensor that
    nothing holds in the map, as in a field that is the same everywhere, stays where it started.
    """
    estimate, furthest = start, options.settled_m
    view, asked, step = glimpse(readings, stand_ins, field_map, start, start.t, FEWEST), start.t, 0
    begun, lost = inside_of_each(readings, view), np.zeros(len(start.t), dtype=np.bool_)
    while view.sensors and step < options.max_steps:
        step += 1
        moved = move_sensors(view, field_map, fit_distortions(view, estimate, options), options)
        moved = replace(moved, t=np.where(lost[:, None], start.t, moved.t))
        move = float(np.abs(moved.t - estimate.t).max())
        estimate, furthest = moved, max(furthest, move)
        progress("alternation", _share_done(move, furthest, options.settled_m))
        if move <= options.settled_m:
            break
        if np.abs(estimate.t - asked).max() <= NEAR_M:
            view = seen_from(view, field_map, estimate)
        else:
            asked = estimate.t
            view = glimpse(readings, stand_ins, field_map, estimate, asked, FEWEST)
            gone = has_left(readings, view, begun)
            if gone.any():
                lost |= gone
                estimate = replace(estimate, t=np.where(lost[:, None], start.t, estimate.t))
                asked = estimate.t
                view = glimpse(readings, stand_ins, field_map, estimate, asked, FEWEST)
    return Alternated(estimate, asked, step)


def fit_distortions(view: View, estimate: Estimate, options: OneKeyOptions) -> Estimate:
    """Solve C and H of every sensor in closed form, and its noise if that is not given."""
    distortion, noise = estimate.distortion.copy(), estimate.noise.copy()
    ridge, variance = estimate.ridge.copy(), view.map_variance.mean(axis=1)
    for s in view.sensors:
        rows = view.readings.rows_of(s)
        b_lidar, b_meas, v = view.b_lidar[rows], view.readings.field[rows], variance[rows]
        weights = row_weights(v, noise[s] ** 2, options.closed_form.weighting)
        fit = fit_distortion(b_lidar, b_meas, weights, options.closed_form)
        distortion[s] = fit.distortion.vector()
        if options.sensor_noise_ut is None:
            residual = fit.distortion.apply(b_lidar) - b_meas
            noise[s] = estimate_noise(residual, v, 1 - DISTORTION / residual.size)
        ridge[s] = fit.ridge * ridge_unit(b_lidar, 1 / (v + noise[s] ** 2))
    return replace(estimate, distortion=distortion, noise=noise, ridge=ridge)


def move_sensors(
    view: View, field_map: QueryableMap, estimate: Estimate, options: OneKeyOptions
) -> Estimate:
    """Optimise all T(i) with the distortions fixed and the weights of the closed form."""
    variance = view.map_variance.mean(axis=1) + estimate.noise[view.readings.sensor] ** 2
    covariance = variance[:, None, None] * np.eye(3)
    batch = batch_readings(view.readings, field_map, estimate.distortion)
    graph = reading_graph(batch, covariance, options.factors)
    start = estimate.positions(view.sensors)
    tie = gtsam.noiseModel.Isotropic.Sigma(3, TIE_M)
    for sensor in view.sensors:
        graph.add(gtsam.PriorFactorPoint3(T(sensor), estimate.t[sensor], tie))
    graph.push_back(estimate.priors.of_places(view.sensors))
    optimised = optimise(graph, start, options.optimizer, options.graph_iterations)
    return estimate.updated(optimised.values, view.sensors)


def _share_done(move: float, furthest: float, settled: float) -> float:
    """Return progress on a logarithmic scale: the loop converges linearly."""
    if move <= settled:
        return 1.0
    return float(np.log(furthest / move) / np.log(furthest / settled))
