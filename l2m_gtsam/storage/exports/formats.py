"""The formats, by name."""

from collections.abc import Callable
from dataclasses import dataclass

from l2m_gtsam.storage.exports.bias_scale import bias_scale_notes, bias_scale_text, not_reducible
from l2m_gtsam.storage.exports.export import Export, Fault, not_mounted
from l2m_gtsam.storage.exports.json_file import json_text
from l2m_gtsam.storage.exports.kalibr import kalibr_text
from l2m_gtsam.storage.exports.ros2_launch import launch_text
from l2m_gtsam.storage.exports.urdf import urdf_text


def _no_notes(_export: Export) -> tuple[str, ...]:
    return ()


@dataclass(frozen=True)
class Format:
    """A format.

    Attributes
    ----------
    text
        The file of an export.
    fault
        What keeps a sensor out of it.
    notes
        What is worth a warning of the sensors that are in it.
    """

    text: Callable[[Export], str]
    fault: Fault = not_mounted
    notes: Callable[[Export], tuple[str, ...]] = _no_notes


FORMATS = {
    "ros2-launch": Format(launch_text),
    "urdf": Format(urdf_text),
    "kalibr": Format(kalibr_text),
    "json": Format(json_text),
    "bias-scale": Format(bias_scale_text, not_reducible, bias_scale_notes),
}
