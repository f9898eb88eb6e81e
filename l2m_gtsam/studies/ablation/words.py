"""What page and figures of the ablation study call things."""

from l2m_gtsam.studies.ablation.table import AblationTable

KINDS = {"sliding_gp": "sliding GP", "dense_gp": "dense GP"}


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
