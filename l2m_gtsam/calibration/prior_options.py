"""What may be known of sensors beforehand: in a configuration, and of a recording's sensors."""

from collections.abc import Mapping
from fnmatch import fnmatchcase
from itertools import combinations
from typing import Literal, Self, TypeVar

import numpy as np
from pydantic import Field, PositiveFloat, model_validator
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.priors import (
    AXES,
    Coordinate,
    Difference,
    Distance,
    Mount,
    Prior,
    Priors,
)
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.options import Options, UnitQuaternion


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
        msg = (
            f"calibration.priors.{key}: no sensor named {pattern!r}; the recording has "
            f"{', '.join(sensors)}"
        )
        raise CalibrationError(msg)
    return found


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
        msg = (
            f"calibration.priors.array.baselines: no sensor named {name!r}; the recording has "
            f"{', '.join(sensors)}"
        )
        raise CalibrationError(msg)
    return sensors.index(name)
