"""What a LiDAR may have seen of a steel hall: nothing, its structures, and what is wrong."""

from dataclasses import replace
from enum import StrEnum

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.simulate.steel_hall import SteelHall, SteelStructure

SHIFT_M = 0.03  # exactly, in a random horizontal direction


class CloudVariant(StrEnum):
    """What the LiDAR saw of the structures."""

    NONE = "none"
    ACCURATE = "accurate"
    SHIFTED = "shifted 3 cm"
    FALSE = "with false"
    SHIFTED_FALSE = "shifted, with false"


def hall_cloud(hall: SteelHall, variant: CloudVariant, seed: int) -> FloatArray:
    """Return what a LiDAR saw, shape (P, 3) in metres, empty for none."""
    rng = np.random.default_rng([seed, 2])
    angle = rng.uniform(-np.pi, np.pi, len(hall.steel))
    unit = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    seen = list(hall.steel) if variant is not CloudVariant.NONE else []
    if variant in (CloudVariant.SHIFTED, CloudVariant.SHIFTED_FALSE):
        seen = [moved(each, SHIFT_M * shift) for each, shift in zip(seen, unit, strict=True)]
    if variant in (CloudVariant.FALSE, CloudVariant.SHIFTED_FALSE):
        seen += hall.timber
    return np.concatenate([np.zeros((0, 3)), *(each.cloud() for each in seen)])


def moved(structure: SteelStructure, shift: FloatArray) -> SteelStructure:
    """Return a structure whose boxes are moved by metres, shape (3,)."""
    boxes = structure.boxes
    return replace(structure, boxes=replace(boxes, centres=boxes.centres + shift))
