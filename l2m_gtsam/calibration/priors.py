"""What is known of sensors beforehand, as factors of the graph, and what readings say against it.

A prior that disagrees pulls the estimate towards itself, so that little may be left to see of it:
what is left is compared with how large it would be if the prior were true, `I - J P J^T` with the
prior's white rows J and the covariance P of the solution. That is the test of its innovation.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import T, distance_prior, rotation_prior
from l2m_gtsam.calibration.optimise import JointCovariance
from l2m_gtsam.calibration.sensor_columns import SENSOR, columns_of
from l2m_gtsam.data import FloatArray

AXES = "xyz"
HOLD_S = 1e-6  # a time offset that is held: far below what any clock of a vehicle resolves


@dataclass(frozen=True)
class Coordinate:
    """A measured coordinate of a sensor's position: axis, value and sigma in metres."""

    sensors: tuple[int, ...]
    axis: int
    value: float
    sigma: float

    @property
    def kind(self) -> str:
        """What it is called."""
        return "measured height" if self.axis == 2 else f"measured {AXES[self.axis]}"

    def factor(self) -> gtsam.NonlinearFactor:
        """Return it as a factor."""
        along = np.eye(3)[self.axis]
        noise = gtsam.noiseModel.Diagonal.Precisions(along / self.sigma**2)
        return gtsam.PriorFactorPoint3(T(self.sensors[0]), self.value * along, noise)


@dataclass(frozen=True)
class Difference:
    """A known part of the vector between two sensors.

    Attributes
    ----------
    sensors
        From which to which.
    vector, sigma
        In the lidar frame in metres, shape (3,); a sigma is infinite where nothing is known.
    kind
        What it is called.
    """

    sensors: tuple[int, ...]
    vector: FloatArray
    sigma: FloatArray
    kind: str

    def factor(self) -> gtsam.NonlinearFactor:
        """Return it as a factor."""
        noise = gtsam.noiseModel.Diagonal.Precisions(self.sigma**-2.0)
        first, second = self.sensors
        return gtsam.BetweenFactorPoint3(T(first), T(second), self.vector, noise)

    @property
    def rigid(self) -> bool:
        """Whether it separates the place of one sensor from that of the other."""
        return bool(np.isfinite(self.sigma).all())


@dataclass(frozen=True)
class Distance:
    """A known distance of two sensors: value and sigma in metres."""

    sensors: tuple[int, ...]
    metres: float
    sigma: float
    kind: str = "baseline"

    def factor(self) -> gtsam.NonlinearFactor:
        """Return it as a factor."""
        first, second = self.sensors
        return distance_prior(first, second, self.metres, self.sigma)


@dataclass(frozen=True)
class Mount:
    """A nominal rotation of a sensor.

    Attributes
    ----------
    sensors
        The sensor.
    R_mag_lidar
        From the lidar's to the sensor's axes, shape (3, 3).
    turn_sigma, stretch_sigma
        Standard deviations of each component of the rotation in rad, and of what scales and soft
        iron add to each entry of C.
    """

    sensors: tuple[int, ...]
    R_mag_lidar: FloatArray
    turn_sigma: float
    stretch_sigma: float
    kind: str = "nominal rotation"

    def factor(self) -> gtsam.NonlinearFactor:
        """Return it as a factor."""
        return rotation_prior(
            self.sensors[0], self.R_mag_lidar, self.turn_sigma, self.stretch_sigma
        )


Prior = Coordinate | Difference | Distance | Mount


@dataclass(frozen=True)
class Priors:
    """All that is known of the sensors of a recording."""

    each: tuple[Prior, ...] = ()

    def among(self, sensors: Collection[int]) -> tuple[Prior, ...]:
        """Return those that speak of these sensors alone."""
        return tuple(prior for prior in self.each if set(prior.sensors) <= set(sensors))

    def without(self, kind: str) -> "Priors":
        """Return all but those of one kind."""
        return Priors(tuple(prior for prior in self.each if prior.kind != kind))

    def of_one(self, sensor: int) -> "Priors":
        """Return those of one sensor, as the only one."""
        return Priors(tuple(replace(prior, sensors=(0,)) for prior in self.among([sensor])))

    def mounts(self) -> dict[int, FloatArray]:
        """Return nominal R_mag_lidar by sensor, shapes (3, 3)."""
        return {each.sensors[0]: each.R_mag_lidar for each in self.each if isinstance(each, Mount)}

    def graph(self, sensors: Collection[int]) -> gtsam.NonlinearFactorGraph:
        """Return the factors on these sensors alone."""
        return _graph(self.among(sensors))

    def of_places(self, sensors: Collection[int]) -> gtsam.NonlinearFactorGraph:
        """Return the factors on ``T(i)`` of these sensors alone."""
        return _graph(tuple(p for p in self.among(sensors) if not isinstance(p, Mount)))


NO_PRIORS = Priors()


def prior_rows(
    prior: Prior, values: gtsam.Values, sensors: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """Return white rows over the parameters of sensors, (M, 16 n), and what is missed, (M,)."""
    factor, columns = prior.factor().linearize(values), columns_of(sensors)
    jacobian, b = factor.jacobian()
    rows, start = np.zeros((len(b), SENSOR * len(sensors))), 0
    for at in (columns[key] for key in list(factor.keys())):
        rows[:, at] = jacobian[:, start : start + at.stop - at.start]
        start += at.stop - at.start
    return rows, np.asarray(b)


def _graph(priors: tuple[Prior, ...]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for prior in priors:
        graph.add(prior.factor())
    return graph


LARGEST = 4.0  # sigmas
# Share of a prior's variance that is not its own doing; with less nothing else informs about it.
INFORMED = 1e-3


@dataclass(frozen=True)
class Contradiction:
    """What is known beforehand of which sensors, and by how many sigmas the readings differ."""

    kind: str
    sensors: tuple[int, ...]
    sigmas: float


def contradictions(
    priors: tuple[Prior, ...], values: gtsam.Values, covariance: JointCovariance
) -> tuple[Contradiction, ...]:
    """Return the priors that the readings and all other priors speak against.

    Parameters
    ----------
    priors
        Of sensors that are solved.
    values
        The solution.
    covariance
        Of it.
    """
    missed = (Contradiction(p.kind, p.sensors, sigmas(p, values, covariance)) for p in priors)
    return tuple(each for each in missed if each.sigmas > LARGEST)


def sigmas(prior: Prior, values: gtsam.Values, covariance: JointCovariance) -> float:
    """Return by how many standard deviations all else differs from a prior, in its worst row."""
    jacobian, b = prior_rows(prior, values, prior.sensors)
    own = np.einsum("ij,jk,ik->i", jacobian, covariance(prior.sensors), jacobian)
    informed = 1 - own > INFORMED
    return float(np.max(np.abs(b[informed]) / np.sqrt(1 - own[informed]), initial=0.0))
