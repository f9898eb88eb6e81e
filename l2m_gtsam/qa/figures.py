"""Pictures: the map, the drive through it, and the sensors on the vehicle."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from l2m_gtsam.data import FloatArray, KnownSensor, Trajectory
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.metrics import MapPicture, Row
from l2m_gtsam.storage.files import atomic_path

# Cells along the longer side of a map picture.
CELLS = 240
ESTIMATE, TRUTH = "#d55e00", "black"  # vermilion and black differ for all kinds of colour vision


@dataclass(frozen=True)
class MapSlice:
    """A map at one height, as pictures.

    Attributes
    ----------
    extent
        Left, right, bottom, top in metres.
    strength
        Strength of the field in uT, NaN where the map has no data, shape (rows, columns).
    sigma
        Its standard deviation per axis in uT, NaN where the map has no data.
    """

    extent: tuple[float, float, float, float]
    strength: FloatArray
    sigma: FloatArray


def slice_map(field_map: FieldMap, height: float) -> MapSlice:
    """Ask a map on a horizontal grid at a height in metres."""
    low, high = field_map.summary.lower[:2], field_map.summary.upper[:2]
    cell = max(high[0] - low[0], high[1] - low[1]) / CELLS
    x, y = (np.arange(low[k], high[k] + cell, cell) for k in (0, 1))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    sample = field_map.query(np.column_stack([grid, np.full(len(grid), height)]))
    sigma = np.sqrt(np.where(np.isfinite(sample.variance), sample.variance, np.nan).mean(axis=1))
    return MapSlice(
        (float(x[0]), float(x[-1]), float(y[0]), float(y[-1])),
        np.linalg.norm(sample.field, axis=1).reshape(len(y), len(x)),
        sigma.reshape(len(y), len(x)),
    )


def map_figure(field_map: FieldMap, height: float | None) -> Figure:
    """Draw strength and uncertainty of a map at a height (the middle of its readings if None).

    Raises
    ------
    MapError
        The map has no data at this height.
    """
    level = _middle(field_map) if height is None else height
    cut = slice_map(field_map, level)
    if not np.isfinite(cut.strength).any():
        low, high = field_map.summary.lower[2], field_map.summary.upper[2]
        msg = (
            f"the map has no data at z = {level:g} m, its readings run from {low:.2f} to "
            f"{high:.2f} m"
        )
        raise MapError(msg)
    figure = _figure(12, 5)
    for axes, image, label, colours in zip(
        figure.subplots(1, 2, sharex=True, sharey=True),
        (cut.strength, cut.sigma),
        ("field strength (uT)", "standard deviation per axis (uT)"),
        ("viridis", "cividis"),
        strict=True,
    ):
        _draw_slice(figure, axes, image, cut.extent, label, colours)
    figure.suptitle(f"Magnetic map at z = {level:.2f} m")
    return figure


def calibration_figure(
    picture: MapPicture,
    drives: Sequence[Trajectory],
    result: CalibrationResult,
    truth: tuple[KnownSensor, ...],
) -> Figure:
    """Draw the map around the drive, and the sensors on the vehicle from above and from the side.

    Parameters
    ----------
    picture
        The map around the drive.
    drives
        Poses of the lidar in the map, drive by drive.
    result
        The calibration; sensors that were not solved are left out.
    truth
        True sensors, where they are known.
    """
    figure = _figure(13, 6.5)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.35, 1), height_ratios=(1.5, 1))
    place, above = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[0, 1])
    side = figure.add_subplot(grid[1, 1])
    strength, extent = np.array(picture.strength), _corners(picture.extent)
    _draw_slice(figure, place, strength, extent, "field strength (uT)", "viridis")
    for k, drive in enumerate(drives):
        label = "_" if k else "drive of the lidar"  # one entry in the legend
        place.plot(*drive.p[:, :2].T, color="white", linewidth=2.2)
        place.plot(*drive.p[:, :2].T, color=ESTIMATE, linewidth=1.0, label=label)
    place.set_title(f"map at z = {picture.height:.2f} m and drive")
    place.legend(loc="upper right")
    solved = [s for s in result.sensors if s.residuals is not None]
    _draw_vehicle(above, solved, truth, (0, 1))
    _draw_vehicle(side, solved, truth, (0, 2))
    above.set_title("sensors on the vehicle, from above")
    side.set_title("from the side")
    above.legend(loc="lower left", bbox_to_anchor=(0, 1.08), ncols=2, fontsize="small")
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def _figure(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), layout="constrained", dpi=130)


def _corners(extent: Row) -> tuple[float, float, float, float]:
    left, right, bottom, top = extent
    return left, right, bottom, top


def _middle(field_map: FieldMap) -> float:
    """Return the height in metres half way between the lowest and the highest reading."""
    return float(field_map.summary.lower[2] + field_map.summary.upper[2]) / 2


def _draw_slice(
    figure: Figure,
    axes: Axes,
    image: FloatArray,
    extent: tuple[float, float, float, float],
    label: str,
    colours: str,
) -> None:
    low, high = np.nanquantile(image, [0.01, 0.99]) if np.isfinite(image).any() else (0.0, 1.0)
    drawn: ScalarMappable = axes.imshow(
        image, origin="lower", extent=extent, cmap=colours, vmin=low, vmax=high
    )
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", facecolor="0.93")
    figure.colorbar(drawn, ax=axes, label=label, shrink=0.8)


def _draw_vehicle(
    axes: Axes,
    sensors: list[SensorCalibration],
    truth: tuple[KnownSensor, ...],
    plane: tuple[int, int],
) -> None:
    names = "xyz"
    rows = list(plane)
    for known in truth:
        axes.plot(*known.t_lidar_mag[rows], "+", color=TRUTH, markersize=10)
    for sensor in sensors:
        at = sensor.t_lidar_mag[rows]
        axes.plot(*at, ".", color=ESTIMATE, markersize=5)
        ellipse = _ellipse(at, sensor.covariance[np.ix_(rows, rows)])
        if ellipse is not None:
            axes.add_patch(ellipse)
        axes.annotate(
            sensor.sensor, tuple(at), xytext=(4, 4), textcoords="offset points", fontsize=7
        )
    axes.plot(0, 0, "s", color="0.4", markersize=8)
    axes.annotate("lidar", (0, 0), xytext=(6, -10), textcoords="offset points", fontsize=7)
    axes.plot([], [], ".", color=ESTIMATE, label="estimate, 95 % ellipse")
    if truth:
        axes.plot([], [], "+", color=TRUTH, label="truth")
    axes.set(xlabel=f"{names[plane[0]]} (m)", ylabel=f"{names[plane[1]]} (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.2)
    axes.grid(alpha=0.3)


def _ellipse(at: FloatArray, covariance: FloatArray) -> Ellipse | None:
    """Return the region that holds the sensor in 95 % of cases; none where it is unbounded."""
    if not np.isfinite(covariance).all():
        return None
    variances, directions = np.linalg.eigh(covariance)
    width, height = 2 * np.sqrt(5.991 * variances)  # chi-square of two, 95 %
    angle = np.degrees(np.arctan2(directions[1, 0], directions[0, 0]))
    return Ellipse(
        (float(at[0]), float(at[1])), width, height, angle=angle, color=ESTIMATE, alpha=0.35
    )
