"""Size of the troubles study, and what goes wrong in it."""

from enum import StrEnum

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.build import MapOptions
from l2m_gtsam.options import Options
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions


class Trouble(StrEnum):
    """What is not as assumed on a drive or its survey."""

    CLEAN = "clean"
    """Nothing."""
    SUITE = "suite"
    """The survey's sensors are off, and count as exact."""
    SUITE_STATED = "suite-stated"
    """The same, and their sigmas are stated."""
    POSES = "poses"
    """Poses of the drive are wrong by errors that last, and count as exact."""
    POSES_STATED = "poses-stated"
    """The same, and their sigmas are stated."""
    WARP = "warp"
    """The map's frame is bent between survey and drive."""
    DRIFT = "drift"
    """H wanders on the drive."""
    PINK = "pink"
    """Noise of the sensors that lasts, beside the white one."""
    NONLINEAR = "nonlinear"
    """Readings are off by a share of themselves that grows with them."""
    SMOOTHED = "smoothed"
    """The sensors have low-pass filters."""
    STEERING = "steering"
    """Iron near the sensors moves with the steering."""
    JUMP = "jump"
    """H of all sensors jumps at one moment of the drive."""
    ALL = "all"
    """All that is not stated, together."""

    @property
    def wrong_suite(self) -> bool:
        """Whether the survey's sensors are off."""
        return self in (Trouble.SUITE, Trouble.SUITE_STATED, Trouble.ALL)

    def has(self, other: "Trouble") -> bool:
        """Whether a drive has another trouble, too."""
        return self in (other, Trouble.ALL)


class World(StrEnum):
    """What kind of places are surveyed; their fields share no code."""

    HALL = "hall"
    """Halls of magnetised cuboids, with posts and racks."""
    OFFICE = "office"
    """Corridors with door frames, a lift, radiators and cable trays, of rods and sheets."""


class TroublesOptions(Options):
    """Size and conditions of the study."""

    seed: int = Field(default=700, ge=0)
    """Of the first place; the others follow it one by one."""
    worlds: tuple[World, ...] = Field(default=(World.HALL, World.OFFICE), min_length=1)
    """Kinds of places."""
    surveys: int = Field(default=10, ge=2)
    """Places of each kind, each with its surveys and maps: what is independent."""
    drives: int = Field(default=4, ge=1)
    """On each map, each with two sensors of random place and distortion."""
    noise: float = Field(default=0.2, gt=0)
    """Of survey and drives alike in uT."""
    readings: int = Field(default=600, ge=100)
    """Of each sensor of a drive."""
    heights: tuple[float, ...] = Field(default=(0.4, 0.7, 1.0), min_length=1)
    """Of the suite's sensors over the floor in metres; those of a drive sit between them."""
    survey_readings: int = Field(default=1500, ge=30)
    """Of a survey."""
    suite_t_m: float = Field(default=0.003, gt=0)
    """Standard deviation of the suite's places in metres, each coordinate."""
    suite_C: float = Field(default=0.005, gt=0)
    """Of each entry of its C: scale and 0.3 degrees."""
    suite_H_ut: float = Field(default=0.3, gt=0)
    """Of its H in uT."""
    pose_m: float = Field(default=0.007, gt=0)
    """Standard deviation of a drive's positions in metres, each coordinate."""
    pose_deg: float = Field(default=0.15, gt=0)
    """Of its rotations in degrees, about each axis."""
    pose_s: float = Field(default=2.0, gt=0)
    """How long these errors last, seconds."""
    warp_m: float = Field(default=0.02, gt=0)
    """Amplitude of the warp in metres, along x and y."""
    warp_length_m: float = Field(default=20.0, gt=0)
    """Length of its wave in metres."""
    drift_ut: float = Field(default=0.3, gt=0)
    """By how much H has wandered at the end of a drive, uT, standard deviation of each axis."""
    pink_ut: float = Field(default=0.2, gt=0)
    """Standard deviation of pink noise in uT."""
    nonlinear: float = Field(default=0.002, gt=0)
    """Share by which a reading of 50 uT is off, along each axis."""
    smoothed_s: float = Field(default=0.15, gt=0)
    """Time constant of the filters in seconds, of first order."""
    steering_ut: float = Field(default=1.0, gt=0)
    """Field of the iron in uT where a vehicle turns by `steering_rad_s`, standard deviation of its
    length."""
    steering_rad_s: float = Field(default=0.5, gt=0)
    """Rate of turn at which the steering is at its stop."""
    jump_ut: float = Field(default=2.0, gt=0)
    """Length of a jump of H in uT, of each sensor in a direction of its own."""
    jump_at: tuple[float, float] = (0.2, 0.8)
    """When: between these shares of a drive, for all sensors at once."""
    map: MapOptions = MapOptions()
    """How the map is made of the survey, and of the structure that the LiDAR saw."""

    @property
    def pose_noise(self) -> PoseNoiseOptions:
        """Errors of a drive's poses."""
        return PoseNoiseOptions(
            position_m=self.pose_m, rotation_deg=self.pose_deg, correlation_s=self.pose_s
        )

    @property
    def suite_sigmas(self) -> FloatArray:
        """Of (t, C row by row, H, time offset), shape (16,)."""
        return np.repeat([self.suite_t_m, self.suite_C, self.suite_H_ut, 0.0], [3, 9, 3, 1])
