"""From which directions the field came, as the lidar sees it."""

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.report.drawing import PAGE, Drawing
from l2m_gtsam.qa.report.panel import Box, Panel, Stroke, letters
from l2m_gtsam.qa.report.svg import GRID, MUTED, X, Y
from l2m_gtsam.records.metrics import SensorMetrics

HEIGHT = 2.7  # inches
SIZE = 164.0  # points of a disk with its room
ENDS = (-1.15, 1.15)
AXIS = letters("start", colour=MUTED)


def equal_area(unit: FloatArray) -> FloatArray:
    """Return directions of one half of space, shape (N, 3), on a disk of radius 1, (N, 2).

    Lambert's azimuthal projection from the nearer pole of z: equal areas stay equal.
    """
    z = np.abs(unit[:, 2])
    r = np.sqrt(np.clip(1 - z, 0, 1))
    flat = np.hypot(unit[:, 0], unit[:, 1])
    scale = np.divide(r, flat, out=np.zeros_like(r), where=flat > 0)
    return np.asarray(unit[:, :2] * scale[:, None])


def directions_figure(sensor: SensorMetrics) -> Drawing:
    """Draw the directions on two disks: the upper and the lower half of space."""
    b = np.array(sensor.series.map)
    unit = b / np.linalg.norm(b, axis=1, keepdims=True)
    panels = []
    for k, (side, name, colour) in enumerate(((1, "upward", X), (-1, "downward", Y))):
        own = unit[np.sign(unit[:, 2]) == side]
        x, y = equal_area(own).T
        panel = Panel(Box(k * PAGE / 2 + (PAGE / 2 - SIZE) / 2, 24, SIZE, SIZE), ENDS, ENDS)
        for elevation in (30, 60):
            panel.ring(np.sqrt(1 - np.sin(np.deg2rad(elevation))), Stroke(GRID, 0.8))
        panel.ring(1.0, Stroke(MUTED, 0.9))
        panel.dots(x, y, 2.4, colour, 0.6)
        middle, top = float(panel.across(0)), float(panel.down(1.02))
        title = f"{name}: {len(own) / len(unit):.0%}"
        panel.text(middle, 16, title, letters("middle", 10.5))
        panel.text(float(panel.across(1.02)), float(panel.down(0)) + 3, "x", AXIS)
        panel.text(middle, top - 2, "y", letters("middle", colour=MUTED))
        panels.append(panel)
    return Drawing(HEIGHT, tuple(panels))
