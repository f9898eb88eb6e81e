"""What may be known of sensors beforehand, as it stands in a configuration."""

from typing import Literal, Self

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from l2m_gtsam.options import Options

UNIT = 1e-3  # a quaternion given to three digits is as long as this


class PlanarMount(Options):
    """Sensors in one plane parallel to the lidar's xy plane."""

    sensors: tuple[str, ...] = Field(min_length=1)
    """Names; `*` stands for anything."""
    sigma_m: float = Field(default=0.002, gt=0)
    """How far each may be over or under the plane, metres."""


class NominalRotation(Options):
    """How a sensor was meant to be turned."""

    quaternion_xyzw: tuple[float, float, float, float]
    """R_lidar_mag, from the sensor's axes to the lidar's."""
    sigma_deg: float = Field(default=2.0, gt=0)
    """How far it may be turned otherwise about each axis, degrees."""
    scale_sigma: float = Field(default=0.05, gt=0)
    """Spread of what scales and soft iron add to each entry of C beside the rotation."""

    @model_validator(mode="after")
    def _is_a_rotation(self) -> Self:
        length = float(np.linalg.norm(self.quaternion_xyzw))
        if abs(length - 1) > UNIT:
            msg = f"quaternion_xyzw must have length 1, this one has {length:.4g}"
            raise ValueError(msg)
        return self


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
