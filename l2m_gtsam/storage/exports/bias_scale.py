"""Offsets and scales for programs that know of no full matrix, with what they leave of C.

In the sensor's own axes ``B_meas = M @ B + H`` with ``M = C @ R_lidar_mag`` symmetric positive.
What a program with an offset and one scale for each axis makes of it is ``D @ (B_meas - H)``.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.storage.exports.export import Export, ExportedSensor, not_correctable, not_oriented
from l2m_gtsam.storage.yaml_file import yaml_text

NODE = "imu_filter_madgwick"
TESLA_PER_MICROTESLA = 1e-6
# Of the field, which turns its direction by up to 3 degrees: more is no correction worth the name.
MOST_LOST = 0.05


@dataclass(frozen=True)
class Reduced:
    """What an offset and scales keep of a distortion, and what they lose.

    Attributes
    ----------
    offset
        To be subtracted, microtesla in the sensor's axes, shape (3,).
    scale
        To multiply by after that, shape (3,).
    lost
        Largest error that remains with both, as a share of the field.
    lost_without_scale
        The same with the offset alone, up to a strength that is common to all directions: the sine
        of the largest error of the direction.
    """

    offset: FloatArray
    scale: FloatArray
    lost: float
    lost_without_scale: float


def reduced(sensor: SensorCalibration) -> Reduced:
    """Return what an offset and a scale for each axis can keep of a sensor's distortion.

    A symmetric M turns directions by up to ``asin((a - b) / (a + b))``, a and b its largest and
    smallest eigenvalue.
    """
    M = sensor.distortion.C @ sensor.R_lidar_mag
    scale = 1 / np.diag(M)
    left = scale[:, None] * M - np.eye(3)
    strengths = np.linalg.svd(M, compute_uv=False)
    spread = (strengths[0] - strengths[-1]) / (strengths[0] + strengths[-1])
    return Reduced(sensor.distortion.H, scale, float(np.linalg.norm(left, 2)), float(spread))


def not_reducible(sensor: SensorCalibration) -> str | None:
    """Return why an offset and scales are no calibration of a sensor, with the figure."""
    # Where it sits does not matter.
    if (reason := not_correctable(sensor) or not_oriented(sensor)) is not None:
        return reason
    lost = reduced(sensor).lost
    if lost <= MOST_LOST:
        return None
    return (
        f"an offset and three scales would leave {lost:.1%} of the field wrong, {MOST_LOST:.0%} is "
        "allowed: C without its rotation is not diagonal; use --format json or `l2m apply`"
    )


def bias_scale_text(export: Export) -> str:
    """Return a ROS 2 parameter file: offsets in tesla and scales without a unit.

    One sensor's parameters are those of the node of imu_tools; of several, each has the node in a
    namespace of its own frame.
    """
    alone = len(export.sensors) == 1
    content = {
        _node(each, alone): {"ros__parameters": _parameters(each)} for each in export.sensors
    }
    return yaml_text(content, "\n".join((*export.origin, *_comments(export))))


def bias_scale_notes(export: Export) -> tuple[str, ...]:
    """Return what is worth a warning of the sensors that are written, a sentence each."""
    notes = []
    for each in export.sensors:
        name, kept = each.calibration.sensor, reduced(each.calibration)
        if kept.lost_without_scale > MOST_LOST:
            notes.append(
                f"{name}: a program that takes the offset alone errs by up to "
                f"{_degrees(kept.lost_without_scale):.1f} deg in direction"
            )
        if each.calibration.moving:
            numbers = ", ".join(moving.name for moving in each.calibration.moving)
            notes.append(f"{name}: the offset is that without what follows {numbers}")
    return tuple(notes)


def _node(sensor: ExportedSensor, alone: bool) -> str:
    return NODE if alone else f"/{sensor.frame}/{NODE}"


def _parameters(sensor: ExportedSensor) -> dict[str, Any]:
    kept = reduced(sensor.calibration)
    offset = kept.offset * TESLA_PER_MICROTESLA
    bias = {f"mag_bias_{axis}": float(value) for axis, value in zip("xyz", offset, strict=True)}
    scale = {
        f"mag_scale_{axis}": float(value) for axis, value in zip("xyz", kept.scale, strict=True)
    }
    return bias | scale


def _comments(export: Export) -> list[str]:
    """Return what the numbers mean and what is lost, a line each."""
    lines = [
        "mag_bias: tesla, to be subtracted; mag_scale: to multiply by after that, where a program",
        f"has it ({NODE} takes the bias alone). Both in the sensor's own axes: its",
        "rotation is not in here, --format ros2-launch and urdf hold it.",
    ]
    for each in export.sensors:
        kept = reduced(each.calibration)
        lines.append(
            f"lost of C, {each.frame}: with bias and scale up to {kept.lost:.2%} of the field and "
            f"{_degrees(kept.lost):.2f} deg of its direction; with the bias alone up to "
            f"{_degrees(kept.lost_without_scale):.2f} deg"
        )
    return [*lines, *bias_scale_notes(export)]


def _degrees(sine: float) -> float:
    return float(np.rad2deg(np.arcsin(sine)))
