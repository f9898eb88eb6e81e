"""What is known of sensors beforehand: as options, as factors, and what readings say against it.

A prior that disagrees pulls the estimate towards itself, so that little may be left to see of it:
what is left is compared with how large it would be if the prior were true, `I - J P J^T` with the
prior's white rows J and the covariance P of the solution. That is the test of its innovation.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import combinations
from typing import Literal, Self, TypeVar

import gtsam
import numpy as np
from pydantic import Field, PositiveFloat, model_validator
from scipy.spatial.transform import Rotation

from l2m_factors import T, distance_prior, rotation_prior
from l2m_gtsam.calibration.optimise import JointCovariance
from l2m_gtsam.calibration.sensor_columns import SENSOR, columns_of
from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.options import Options, UnitQuaternion

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


class PlanarMount(Options):
    """Sensors in one plane parallel to the lidar's xy plane."""

    sensors: tuple[str, ...] = Field(min_length=1)
    """Names; `*` stands for anything."""
    sigma_m: float = Field(default=0.002, gt=0)
    """How far each may be over or under the plane, metres."""


class NominalRotation(Options):
    """How a sensor was meant to be turned."""

    quaternion_xyzw: UnitQuaternion
    """R_lidar_mag, from the sensor's axes to the lidar's."""
    sigma_deg: float = Field(default=2.0, gt=0)
    """How far it may be turned otherwise about each axis, degrees."""
    scale_sigma: float = Field(default=0.05, gt=0)
    """Spread of what scales and soft iron add to each entry of C beside the rotation."""


class Baseline(Options):
    """Where two sensors of an array are from each other: a vector or a distance."""

    from_: str = Field(alias="from")
    """Name of the first sensor."""
    to: str
    """Name of the second."""
    vector: tuple[float, float, float] | None = None
    """From the first to the second in the lidar frame, metres."""
    distance: PositiveFloat | None = None
    """Between them in metres, where the array's orientation is not known."""
    sigma_m: float = Field(default=0.002, gt=0)
    """Standard deviation of the distance or of each component of the vector, metres."""

    @model_validator(mode="after")
    def _is_one_of_both(self) -> Self:
        if (self.vector is None) == (self.distance is None):
            raise ValueError("give either `vector` or `distance`")
        if self.from_ == self.to:
            msg = f"{self.to!r} has no baseline to itself"
            raise ValueError(msg)
        return self


class ArrayOptions(Options):
    """The geometry of an array of sensors."""

    baselines: tuple[Baseline, ...] = ()
    """Vectors or distances between its sensors."""


class PriorOptions(Options):
    """What is known of sensors beforehand; `*` in a sensor's name stands for anything."""

    position: dict[str, dict[Literal["x", "y", "z"], tuple[float, PositiveFloat]]] = Field(
        default_factory=dict
    )
    """Measured coordinates of `t_lidar_mag` by sensor and axis, each with its standard deviation,
    metres."""
    planar: tuple[PlanarMount, ...] = ()
    """Sensors that are at one height."""
    rotation: dict[str, NominalRotation] = Field(default_factory=dict)
    """Nominal rotations by sensor."""
    array: ArrayOptions = ArrayOptions()
    """Where sensors are from each other."""


Known = TypeVar("Known")


def priors_of(options: PriorOptions, sensors: tuple[str, ...]) -> Priors:
    """Return what is known of the sensors of a recording.

    Raises
    ------
    CalibrationError
        A name is none of the recording's, or a sensor is spoken of twice.
    """
    found: list[Prior] = []
    axes = {
        (name, axis): known
        for name, coordinates in options.position.items()
        for axis, known in coordinates.items()
    }
    for axis in AXES:
        own = {name: known for (name, of), known in axes.items() if of == axis}
        for sensor, (value, sigma) in by_sensor(own, sensors, "position").items():
            found.append(Coordinate((sensor,), AXES.index(axis), value, sigma))
    for plane in options.planar:
        found += planar(plane, sensors)
    for sensor, nominal in by_sensor(options.rotation, sensors, "rotation").items():
        found.append(mount(sensor, nominal))
    found += [between(baseline, sensors) for baseline in options.array.baselines]
    return Priors(tuple(found))


def by_sensor(entries: Mapping[str, Known], sensors: tuple[str, ...], key: str) -> dict[int, Known]:
    """Return what is said by name or pattern, by the index of the sensor that it is said of."""
    said: dict[int, str] = {}
    for pattern in entries:
        for sensor in matching(pattern, sensors, key):
            if sensor in said:
                msg = (
                    f"calibration.priors.{key}: {said[sensor]!r} and {pattern!r} both speak of "
                    f"{sensors[sensor]!r}; leave one of them out"
                )
                raise CalibrationError(msg)
            said[sensor] = pattern
    return {sensor: entries[pattern] for sensor, pattern in said.items()}


def matching(pattern: str, sensors: tuple[str, ...], key: str) -> list[int]:
    """Return the sensors that a name or a pattern stands for; there is at least one."""
    found = [index for index, name in enumerate(sensors) if fnmatchcase(name, pattern)]
    if not found:
        raise _no_sensor(key, pattern, sensors)
    return found


def _no_sensor(key: str, name: str, sensors: tuple[str, ...]) -> CalibrationError:
    return CalibrationError(
        f"calibration.priors.{key}: no sensor named {name!r}; the recording has "
        f"{', '.join(sensors)}"
    )


def planar(plane: PlanarMount, sensors: tuple[str, ...]) -> list[Difference]:
    """Return equal heights as differences of pairs.

    With an unknown height of the plane and each of n sensors off it by an independent sigma, the
    likelihood of the heights is that of all pairs with a sigma of ``sigma sqrt(n)``.
    """
    named = sorted({s for name in plane.sensors for s in matching(name, sensors, "planar")})
    if len(named) < 2:
        only = ", ".join(plane.sensors)
        msg = f"calibration.priors.planar: {only} is one sensor; a plane takes two or more"
        raise CalibrationError(msg)
    sigma = np.array([np.inf, np.inf, plane.sigma_m * np.sqrt(len(named))])
    pairs = combinations(named, 2)
    return [Difference(pair, np.zeros(3), sigma, "planar mount") for pair in pairs]


def mount(sensor: int, nominal: NominalRotation) -> Mount:
    """Return a nominal rotation."""
    R_mag_lidar = Rotation.from_quat(nominal.quaternion_xyzw).as_matrix().T
    turn = float(np.deg2rad(nominal.sigma_deg))
    return Mount((sensor,), R_mag_lidar, turn, nominal.scale_sigma)


def between(baseline: Baseline, sensors: tuple[str, ...]) -> Prior:
    """Return a baseline."""
    first, second = (one(name, sensors) for name in (baseline.from_, baseline.to))
    if baseline.distance is not None:
        return Distance((first, second), baseline.distance, baseline.sigma_m)
    vector = np.array(baseline.vector, dtype=float)
    return Difference((first, second), vector, np.full(3, baseline.sigma_m), "baseline")


def one(name: str, sensors: tuple[str, ...]) -> int:
    """Return the sensor of that very name."""
    if name not in sensors:
        raise _no_sensor("array.baselines", name, sensors)
    return sensors.index(name)
