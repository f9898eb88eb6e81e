"""The ablation study: ``l2m study ablation``."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from l2m_gtsam.data import FloatArray
from l2m_gtsam.studies.ablation.cells import (
    AblationCell,
    AblationOptions,
    MappedDrives,
    Solver,
    ablation_batch,
    mapped_drives,
)
from l2m_gtsam.studies.ablation.map_image import MapImage, map_image
from l2m_gtsam.studies.ablation.table import (
    FAR_M,
    FAR_UT,
    AblationTable,
    Combination,
    ErrorQuantiles,
    MapRow,
    ablation_table,
)
from l2m_gtsam.studies.study import Study

PICTURE = "map"
LOOKED_AT = 4  # drives along which a map is compared with the world
CLAIMED_UT = 0.2
"""By so much, the paper says, the sliding GP lowers the mean error of H where fingerprints are
dense."""
KINDS = {"sliding_gp": "sliding GP", "dense_gp": "dense GP"}
# Okabe and Ito's colours differ for all kinds of colour vision.
COLOURS = {
    Solver.OLS: "#999999",
    Solver.RRTLS: "#e69f00",
    Solver.PAPER: "#56b4e9",
    Solver.LIKELIHOOD: "#009e73",
    Solver.ONE_KEY: "#0072b2",
}
ERRORS = (("t", 100.0, "error of t (cm)"), ("C", 1.0, "error of C"), ("H", 1.0, "error of H (uT)"))
"""Attribute, scale and label of each row of the figure."""
PITCH, WIDTH = 0.16, 0.12  # of boxes, where groups are 1 apart
STRENGTHS = "cividis"  # reads the same for all kinds of colour vision
MAP_INCHES = 2.8
CUT = (0.02, 0.98)  # quantiles of the true strength that the colours span


class AblationStudy(Study[AblationOptions, AblationCell, AblationTable]):
    """Maps, densities and weights; a cell is one map's picture or a batch of calibrations on it."""

    name = "ablation"
    title = "What map, density and weights do"
    size = frozenset({"batches"})

    def keys(self, options: AblationOptions) -> tuple[str, ...]:
        """Return a picture and batches for each map: kind, number of the density, which cell."""
        cells = [PICTURE, *(f"{number:03d}" for number in range(options.batches))]
        return tuple(
            f"{kind}-{density}-{cell}"
            for density in range(len(options.spacings))
            for kind in options.kinds
            for cell in cells
        )

    def site(self, options: AblationOptions, key: str) -> str:
        """Return the map: kind and number of the density."""
        return key.rpartition("-")[0]

    def prepare(self, options: AblationOptions, site: str) -> MappedDrives:
        """Return the map with the drives through it."""
        return mapped_drives(options, *map_of(options, site))

    def compute(self, options: AblationOptions, key: str, shared: MappedDrives) -> AblationCell:
        """Draw the map, or calibrate a batch of sensors on it."""
        cell = key.rpartition("-")[2]
        if cell != PICTURE:
            return AblationCell(batch=ablation_batch(options, shared, int(cell)))
        hall = shared.hall
        drives = hall.drives[:LOOKED_AT]
        picture = map_image(shared.field_map, hall.part, hall.floor, drives, options.window)
        return AblationCell(picture=picture)

    def summarise(
        self, options: AblationOptions, cells: Mapping[str, AblationCell]
    ) -> AblationTable:
        """Join the batches of each map."""
        parts: dict[tuple[str, float], list[AblationCell]] = {}
        for key, cell in cells.items():
            parts.setdefault(map_of(options, self.site(options, key)), []).append(cell)
        return ablation_table(options, parts)

    def page_context(self, summary: AblationTable) -> dict[str, Any]:
        """Return names and thresholds."""
        return {
            "Solver": Solver,
            "kind_label": kind_label,
            "spacing_label": spacing_label,
            "density_label": density_label,
            "claimed": CLAIMED_UT,
            "far_m": FAR_M,
            "far_ut": FAR_UT,
        }

    def figures(self, summary: AblationTable) -> dict[str, Figure]:
        """Draw errors and maps."""
        return {"ablation": box_figure(summary), "ablation_maps": map_figure(summary)}


def map_of(options: AblationOptions, site: str) -> tuple[str, float]:
    """Return kind and spacing of a map by the name of its site."""
    kind, _, density = site.rpartition("-")
    return kind, options.spacings[int(density)]


def kind_label(kind: str) -> str:
    """Return the name of a kind of map for readers."""
    return KINDS.get(kind, kind)


def spacing_label(spacing: float) -> str:
    """Return a density in words."""
    return "the whole survey" if spacing == 0.0 else f"one every {spacing:g} m"


def density_label(table: AblationTable, spacing: float) -> str:
    """Return a density in words, with fingerprints per square metre."""
    picture = next(each.picture for each in table.maps if each.spacing == spacing)
    return f"{spacing_label(spacing)} ({picture.per_m2:.1f} per m²)"


def box_figure(table: AblationTable) -> Figure:
    """Draw the errors: rows of the figure are t, C and H, columns densities."""
    spacings = table.options.spacings
    figure = Figure(figsize=(3.6 * len(spacings) + 0.6, 8.2), layout="constrained", dpi=150)
    grid = figure.subplots(3, len(spacings), sharex=True, sharey="row", squeeze=False)
    for row, (name, scale, label) in zip(grid, ERRORS, strict=True):
        for axes, spacing in zip(row, spacings, strict=True):
            combinations = [each for each in table.rows if each.spacing == spacing]
            draw_boxes(axes, combinations, table.options.kinds, name, scale)
            axes.tick_params(labelleft=axes is row[0])
        row[0].set_ylabel(label)
    for axes, spacing in zip(grid[0], spacings, strict=True):
        axes.set_title(density_label(table, spacing), fontsize=10)
    handles = [Patch(facecolor=COLOURS[solver], label=solver.value) for solver in Solver]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
    return figure


def draw_boxes(
    axes: Axes, combinations: Sequence[Combination], kinds: tuple[str, ...], name: str, scale: float
) -> None:
    """Draw the boxes of one kind of error at one density, grouped by the kind of map."""
    for each in combinations:
        spread: ErrorQuantiles | None = getattr(each, name)
        if spread is None:
            continue
        place = list(Solver).index(each.solver) - (len(Solver) - 1) / 2
        at = kinds.index(each.kind) + PITCH * place
        draw_box(axes, at, box(spread, scale), COLOURS[each.solver])
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(LogLocator(subs=tuple(np.arange(1.0, 10.0))))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xticks(range(len(kinds)), [kind_label(kind) for kind in kinds])
    axes.set_xlim(-0.55, len(kinds) - 0.45)
    axes.grid(axis="y", alpha=0.3)
    axes.tick_params(axis="x", length=0)


def draw_box(axes: Axes, at: float, stats: dict[str, float], colour: str) -> None:
    """Draw one box at a place along x."""
    line = {"color": "0.2", "linewidth": 0.8}
    axes.bxp(
        [stats],
        positions=[at],
        widths=WIDTH,
        showfliers=False,
        showmeans=True,
        patch_artist=True,
        boxprops={"facecolor": colour, "edgecolor": "0.2", "linewidth": 0.8},
        medianprops={"color": "black", "linewidth": 1.4},
        meanprops={"marker": "D", "markersize": 3, "markerfacecolor": "white"}
        | {"markeredgecolor": "black", "markeredgewidth": 0.7},
        whiskerprops=line,
        capprops=line,
    )


def box(spread: ErrorQuantiles, scale: float) -> dict[str, Any]:
    """Return a box for ``Axes.bxp``: quartiles, whiskers at 5 and 95 %, and the mean."""
    names = {"whislo": "p05", "q1": "p25", "med": "median", "q3": "p75", "whishi": "p95"}
    stats = {key: scale * getattr(spread, name) for key, name in names.items()}
    return stats | {"mean": scale * spread.mean}


def map_figure(table: AblationTable) -> Figure:
    """Draw the strength of the field: rows of the figure are densities, columns kinds of maps."""
    spacings, kinds = table.options.spacings, table.options.kinds
    left, right, bottom, top = table.maps[0].picture.extent
    high = MAP_INCHES * (top - bottom) / (right - left)
    size = (len(kinds) + 1) * MAP_INCHES + 1.8, len(spacings) * (high + 0.15) + 0.7
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
    """Return the weakest and the strongest field that colours distinguish, uT: one scale for all.

    Only where maps have data: between the racks' posts the truth is far stronger.
    """
    picture = maps[0].picture
    seen = picture.truth[np.isfinite(picture.strength) & np.isfinite(picture.truth)]
    known = seen if len(seen) else picture.truth[np.isfinite(picture.truth)]
    low, high = np.quantile(known, CUT)
    return float(low), float(high)


def draw(axes: Axes, picture: MapImage, image: FloatArray, span: tuple[float, float]) -> AxesImage:
    """Draw one picture; grey where there is nothing."""
    axes.set(aspect="equal", facecolor="0.9")
    return axes.imshow(
        image, origin="lower", extent=picture.extent, cmap=STRENGTHS, vmin=span[0], vmax=span[1]
    )


def mark(axes: Axes, picture: MapImage) -> None:
    """Draw the fingerprints, those at several heights as one, and write the map's error."""
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


ABLATION = AblationStudy()
