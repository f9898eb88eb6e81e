"""Values that are shown while the pointer is over a part of a figure: titles, as SVG has them.

No script is needed. Whoever has no pointer finds the values in the tables and in `metrics.json`.
"""

from collections.abc import Sequence

import numpy as np
from markupsafe import escape
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.transforms import Transform

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.qa.metrics.plain import evenly
from l2m_gtsam.qa.report.drawing import Drawing, Panel
from l2m_gtsam.qa.report.svg import hover_name
from l2m_gtsam.text import shown_lines

MOST = 64  # parts of a figure: about two millimetres of its width each
REACH = 4.5  # points around a place
CELLS = 24  # along the longer side of a map


def some(count: int) -> IntArray:
    """Return the rows of so many whose values are shown, shape (M,)."""
    return evenly(count, MOST)


def some_and_marked(marked: BoolArray) -> IntArray:
    """Return the rows of readings whose values are shown, shape (M,).

    Parameters
    ----------
    marked
        Which of N readings are drawn as crosses, shape (N,); of these as many are shown as of all.
    """
    crosses = np.flatnonzero(marked)
    return np.union1d(some(len(marked)), crosses[some(len(crosses))])


def strips(figure: Drawing, x: FloatArray, words: Sequence[str]) -> None:
    """Show words over the height of a figure, each half way to its neighbours along x, (N,)."""
    first, last = figure.panels[0].box, figure.panels[-1].box
    at = np.sort(figure.panels[0].across(x))
    edges = np.concatenate([[first.left], (at[1:] + at[:-1]) / 2, [first.right]])
    height = last.bottom - first.top
    parts = [
        _rectangle(float(a), first.top, float(b - a), height, words[k])
        for a, b, k in zip(edges[:-1], edges[1:], np.argsort(x, kind="stable"), strict=True)
    ]
    _add(figure, parts)


def places(figure: Drawing, panel: Panel, at: FloatArray, words: Sequence[str]) -> None:
    """Show words around places of a panel, shape (N, 2)."""
    parts = [
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="{REACH}">'
        f"<title>{escape(shown_lines(text))}</title></circle>"
        for a, b, text in zip(panel.across(at[:, 0]), panel.down(at[:, 1]), words, strict=True)
    ]
    _add(figure, parts)


def cells(figure: Drawing, panel: Panel, at: FloatArray, words: Sequence[str]) -> None:
    """Show words over cells of a width and height of one around places of a panel, (N, 2)."""
    wide, high = panel.box.width / np.ptp(panel.x), panel.box.height / np.ptp(panel.y)
    left, top = panel.across(at[:, 0] - 0.5), panel.down(at[:, 1] + 0.5)
    parts = [
        _rectangle(float(a), float(b), float(wide), float(high), text)
        for a, b, text in zip(left, top, words, strict=True)
    ]
    _add(figure, parts)


def axes_places(axes: Axes, at: FloatArray, words: Sequence[str]) -> None:
    """Show words around places of matplotlib's axes, shape (N, 2)."""
    for (a, b), text in zip(at, words, strict=True):
        # In front of all that is written: a name may lie over the place of another.
        axes.plot(a, b, "o", color="none", markersize=2 * REACH, gid=hover_name(text), zorder=9)


def axes_strips(axes: Axes, x: FloatArray, words: Sequence[str], height: float = 1.0) -> None:
    """Show words along axes whose limits are set, each half way to its neighbours.

    Parameters
    ----------
    axes
        The axes; of several with one x, the lowest.
    x, words
        Where, and what, N each.
    height
        Of the strips, in heights of the axes.
    """
    low, high = axes.get_xlim()
    order = np.argsort(x, kind="stable")
    at = np.asarray(x)[order]
    edges = np.concatenate([[low], (at[1:] + at[:-1]) / 2, [high]])
    for a, b, k in zip(edges[:-1], edges[1:], order, strict=True):
        axes_box(axes, (a, 0.0), (b - a, height), words[k], axes.get_xaxis_transform())


def axes_image(axes: Axes, image: FloatArray, extent: Sequence[float], unit: str) -> None:
    """Show the values of an image of axes, shape (rows, columns); nothing where there are none."""
    left, right, bottom, top = extent
    step = max(1, -(-max(image.shape) // CELLS))
    wide, high = (right - left) / image.shape[1], (top - bottom) / image.shape[0]
    for row in range(0, image.shape[0], step):
        for column in range(0, image.shape[1], step):
            part = image[row : row + step, column : column + step]
            known = part[np.isfinite(part)]
            if not len(known):
                continue
            corner = left + column * wide, bottom + row * high
            size = part.shape[1] * wide, part.shape[0] * high
            x, y = corner[0] + size[0] / 2, corner[1] + size[1] / 2
            words = f"x {x:.1f} m, y {y:.1f} m: {float(np.median(known)):.2f} {unit}"
            axes_box(axes, corner, size, words, axes.transData)


def axes_box(
    axes: Axes,
    corner: tuple[float, float],
    size: tuple[float, float],
    words: str,
    transform: Transform,
) -> None:
    """Show words over a rectangle, which is not seen and changes no limits."""
    part = Rectangle(corner, *size, facecolor="none", edgecolor="none", transform=transform)
    part.set(gid=hover_name(words), in_layout=False, zorder=9, clip_on=False)
    axes.add_artist(part)


def _rectangle(x: float, y: float, width: float, height: float, words: str) -> str:
    return (
        f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}">'
        f"<title>{escape(shown_lines(words))}</title></rect>"
    )


def _add(figure: Drawing, parts: Sequence[str]) -> None:
    """Add parts above all else."""
    if parts:
        figure.parts.append(f'<g class="hover">{"".join(parts)}</g>')
