"""What the honesty study tries: noise levels, surveys, drives, and what goes wrong on them."""

from enum import StrEnum
from typing import Annotated

from pydantic import Field, field_validator

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.maps.build import MapOptions
from l2m_gtsam.options import Options
from l2m_gtsam.studies.honesty.trouble import POSE_NOISE

Noise = Annotated[float, Field(gt=0)]


class Condition(StrEnum):
    """What goes wrong on a drive beside noise."""

    CLEAN = "clean"
    """Nothing."""
    TROUBLED = "troubled"
    """Clocks are off, poses are wrong by errors that last, a tenth of the readings is spoilt."""


class HonestyOptions(Options):
    """Size and conditions of the study."""

    seed: int = Field(default=100, ge=0)
    """Of the first hall; the others follow it one by one."""
    surveys: int = Field(default=20, ge=2)
    """Halls at each noise level, each with its survey and map: what is independent."""
    drives: int = Field(default=10, ge=1)
    """On each map, each with a sensor of random place and distortion."""
    noises: tuple[Noise, ...] = Field(default=(0.1, 0.2, 0.5), min_length=1)
    """Of survey and drives alike in uT, for drives on which nothing else is wrong."""
    troubled_noises: tuple[Noise, ...] = (0.2,)
    """The same for drives on which everything is wrong."""
    readings: int = Field(default=220, ge=30)
    """Of a drive."""
    heights: tuple[float, ...] = Field(default=(0.4, 0.7, 1.0), min_length=1)
    """Passes of a survey over the floor in metres; sensors sit between the lowest and the
    highest."""
    survey_readings: int = Field(default=1500, ge=30)
    """Of a survey."""
    start: float = Field(default=0.05, gt=0)
    """Each axis of a start is at most so many metres off: the basin is another study."""
    map: MapOptions = MapOptions()
    """How the map is made of the survey, and of the structure that the LiDAR saw."""
    solve: OneKeyOptions = OneKeyOptions(pose_noise=POSE_NOISE)
    """How a calibration is solved; its `uncertainty` is set to each kind in turn."""

    @field_validator("map")
    @classmethod
    def _knows_its_errors(cls, chosen: MapOptions) -> MapOptions:
        if chosen.kind != "harmonic":
            raise ValueError(f"kind {chosen.kind} does not know its errors; accepted: harmonic")
        return chosen
