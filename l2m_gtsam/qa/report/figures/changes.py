"""What changed where, at a glance: steel on the floor of the map, and where it acts on a drive."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.sources.source import SourceShape
from l2m_gtsam.qa.report.figures.map import BELOW, draw_source, mark, wide
from l2m_gtsam.records.metrics import MapPicture
from l2m_gtsam.records.places import ChangedSource

LEAST_UT = 0.2  # weaker it is not drawn
MARGIN_M = 0.5  # about what is drawn


def changes_figure(
    picture: MapPicture, path: FloatArray, sources: Sequence[ChangedSource]
) -> Figure:
    """Draw steel that came, went or was moved, and what it adds along a drive.

    Parameters
    ----------
    picture
        Of the map: its floor.
    path
        Of the drive, NaN between two drives, metres, shape (N, 3).
    sources
        What changed; they are numbered from 1.
    """
    left, right, bottom, top = picture.extent
    places = np.array([each.position[:2] for each in sources])
    low = np.minimum([left, bottom], places.min(axis=0)) - MARGIN_M
    high = np.maximum([right, top], places.max(axis=0)) + MARGIN_M
    figure, axes = wide(high - low)
    floor = np.where(np.isfinite(np.array(picture.strength, dtype=float)), 1.0, np.nan)
    style: Any = {"origin": "lower", "extent": picture.extent, "cmap": "Greys", "vmin": 0.0}
    axes.imshow(floor, vmax=10.0, **style)
    axes.plot(*path[:, :2].T, color="0.45", linewidth=1.0)
    added = added_field(path, sources)
    affected = added > LEAST_UT
    top_ut = max(float(added[affected].max(initial=0.0)), 2 * LEAST_UT)
    drawn = axes.scatter(
        path[affected, 0],
        path[affected, 1],
        c=added[affected],
        s=26,
        cmap="YlOrRd",
        vmin=0.0,
        vmax=top_ut,
    )
    mark(axes, path[0, :2], "start")
    for number, source in enumerate(sources, start=1):
        draw_source(axes, source, str(number))
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.grid(visible=False)
    figure.colorbar(drawn, ax=axes, label="added to the field along the drive (µT)", **BELOW)
    return figure


def added_field(path: FloatArray, sources: Sequence[ChangedSource]) -> FloatArray:
    """Return the length of the field of sources along a path in uT, shape (N,)."""
    known = np.isfinite(path).all(axis=1)
    field = np.zeros((int(known.sum()), 3))
    for each in sources:
        shape = SourceShape(np.concatenate([each.position, each.moment, each.half_axis]))
        field += shape.field_and_gradient(path[known])[0]
    added = np.zeros(len(path))
    added[known] = np.linalg.norm(field, axis=1)
    return added
