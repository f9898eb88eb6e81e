"""Options of maps that are built fast: coarse, but of the same code."""

from typing import Any

from l2m_gtsam.maps.build import MapOptions

QUICK_HARMONIC: dict[str, Any] = {
    "learning": {"windows": 1, "modes": 100, "readings": 500},
    "search": {"rounds": 0},
    "tiling": {"overlap": 0.3, "margin": 0.5},
    "modes": 200,
}


def quick(kind: str) -> MapOptions:
    """Return the options of a kind of map."""
    return MapOptions.model_validate({"kind": kind, "harmonic": QUICK_HARMONIC})
