"""Models of a sensor and moving fields as ``calibration.yaml`` keeps them."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from l2m_gtsam.records.sensor_models import (
    Coefficients,
    Model,
    ModelComparison,
    ModelFigures,
    MovingField,
)
from l2m_gtsam.storage.file_model import Lenient, Matrix, Vector


class MovingEntry(Lenient):
    """What a recorded number adds to the readings."""

    h: Vector
    sigma: Vector


class CoefficientsEntry(Lenient):
    """Coefficients of a model, or their sigmas; h by the names of the numbers."""

    C: Matrix
    H: Vector
    h: dict[str, Vector]
    E: Matrix


class FiguresEntry(Lenient):
    """How one model does."""

    model: Model
    parameters: int
    rms: float
    held_out_rms: float
    held_out_score: float
    score_error: float
    behind: float
    behind_error: float
    bic: float
    bic_above: float


class ModelsEntry(Lenient):
    """All models side by side."""

    recommended: Model
    reason: str
    readings: int
    independent: float
    segments: int
    regressors: tuple[str, ...]
    fits: tuple[FiguresEntry, ...]
    coefficients: CoefficientsEntry
    sigma: CoefficientsEntry


def moving_entry(moving: tuple[MovingField, ...]) -> dict[str, Any]:
    """Return what recorded numbers add as plain values, by their names."""
    return {each.name: {"h": each.h.tolist(), "sigma": each.sigma.tolist()} for each in moving}


def moving_of(entries: Mapping[str, MovingEntry]) -> tuple[MovingField, ...]:
    """Return what recorded numbers add from its entry."""
    return tuple(
        MovingField(name, np.array(each.h), np.array(each.sigma)) for name, each in entries.items()
    )


def models_entry(comparison: ModelComparison) -> dict[str, Any]:
    """Return a comparison as plain values."""
    names = comparison.regressors
    return {
        "recommended": comparison.recommended.value,
        "reason": comparison.reason,
        "readings": comparison.readings,
        "independent": comparison.independent,
        "segments": comparison.segments,
        "regressors": list(names),
        "fits": [{**vars(each), "model": each.model.value} for each in comparison.fits],
        "coefficients": _coefficients_entry(comparison.coefficients, names),
        "sigma": _coefficients_entry(comparison.sigma, names),
    }


def models_of(entry: ModelsEntry) -> ModelComparison:
    """Return a comparison from its entry."""
    return ModelComparison(
        fits=tuple(ModelFigures(**dict(each)) for each in entry.fits),
        regressors=entry.regressors,
        readings=entry.readings,
        independent=entry.independent,
        segments=entry.segments,
        recommended=entry.recommended,
        reason=entry.reason,
        coefficients=_coefficients(entry.coefficients),
        sigma=_coefficients(entry.sigma),
    )


def _coefficients_entry(found: Coefficients, names: tuple[str, ...]) -> dict[str, Any]:
    h = {name: each.tolist() for name, each in zip(names, found.h, strict=True)}
    return {"C": found.C.tolist(), "H": found.H.tolist(), "h": h, "E": found.E.tolist()}


def _coefficients(entry: CoefficientsEntry) -> Coefficients:
    h = np.array(list(entry.h.values())).reshape(-1, 3)
    return Coefficients(np.array(entry.C), np.array(entry.H), h, np.array(entry.E))
