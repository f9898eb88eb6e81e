"""The ablation study's maps as pictures, beside the world."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from l2m_gtsam.data import FloatArray
from l2m_gtsam.studies.ablation.map_picture import MapPicture
from l2m_gtsam.studies.ablation.table import AblationTable, MapRow
from l2m_gtsam.studies.ablation.words import density_label, kind_label

COLOURS = "cividis"  # reads the same for all kinds of colour vision
WIDTH = 2.8  # inches of a map
CUT = (0.02, 0.98)  # quantiles of the true strength that the colours span


def map_figure(table: AblationTable) -> Figure:
    """Draw the strength of the field: rows of the figure are densities, columns kinds of maps."""
    spacings, kinds = table.options.spacings, table.options.kinds
    left, right, bottom, top = table.maps[0].picture.extent
    high = WIDTH * (top - bottom) / (right - left)
    size = (len(kinds) + 1) * WIDTH + 1.8, len(spacings) * (high + 0.15) + 0.7
    figure = Figure(figsize=size, layout="constrained", dpi=150)
    grid = figure.subplots(len(spacings), len(kinds) + 1, sharex=True, sharey=True, squeeze=False)
    span = strengths(table.maps)
    for row, spacing in zip(grid, spacings, strict=True):
        maps = [each for each in table.maps if each.spacing == spacing]
        for axes, each in zip(row, maps, strict=False):
            drawn = draw(axes, each.picture, each.picture.strength, span)
            mark(axes, each.picture)
        draw(row[-1], maps[-1].picture, maps[-1].picture.truth, span)
        row[0].set_ylabel(f"{density_label(table, spacing)}\ny (m)", fontsize=9)
    for axes, name in zip(grid[0], [*map(kind_label, kinds), "truth"], strict=True):
        axes.set_title(name)
    for axes in grid[-1]:
        axes.set_xlabel("x (m)")
    figure.colorbar(
        drawn, ax=grid, label="field strength (uT)", shrink=0.8, pad=0.01, extend="both"
    )
    return figure


def strengths(maps: tuple[MapRow, ...]) -> tuple[float, float]:
    """Return the weakest and the strongest field that colours tell apart, uT: one scale for all.

    Only where maps have data: between the racks' posts the truth is far stronger.
    """
    picture = maps[0].picture
    seen = picture.truth[np.isfinite(picture.strength) & np.isfinite(picture.truth)]
    known = seen if len(seen) else picture.truth[np.isfinite(picture.truth)]
    low, high = np.quantile(known, CUT)
    return float(low), float(high)


def draw(
    axes: Axes, picture: MapPicture, image: FloatArray, span: tuple[float, float]
) -> AxesImage:
    """Draw one picture; grey where there is nothing."""
    axes.set(aspect="equal", facecolor="0.9")
    return axes.imshow(
        image, origin="lower", extent=picture.extent, cmap=COLOURS, vmin=span[0], vmax=span[1]
    )


def mark(axes: Axes, picture: MapPicture) -> None:
    """Draw the fingerprints, those at several heights as one, and say what the map is worth."""
    x, y = picture.fingerprints.T
    axes.plot(x, y, ".", color="white", markersize=1.6, markeredgewidth=0, alpha=0.8)
    axes.text(
        0.98,
        0.03,
        f"rms error {picture.rmse:.2f} uT",
        transform=axes.transAxes,
        ha="right",
        fontsize=8,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5},
    )
