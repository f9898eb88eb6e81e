"""A harmonic map in figures and words: what it was learnt from and what speaks against it."""

import numpy as np

from l2m_gtsam.maps.field_map import MapSummary
from l2m_gtsam.maps.harmonic.explanation import Explanation
from l2m_gtsam.maps.harmonic.learnt import Learnt
from l2m_gtsam.maps.training import narrow

IN_SIGMAS = "their errors are in the sigmas"
LOCAL = "its own, about those of the map"


def summary_of(kind: str, learnt: Learnt) -> MapSummary:
    """Return the figures of a map of this kind."""
    points = learnt.readings.points
    h = learnt.hyperparameters
    return MapSummary(
        kind=kind,
        readings=learnt.origin.readings,
        rows=len(points),
        lower=points.min(axis=0),
        upper=points.max(axis=0),
        facts={
            "noise of a reading (uT)": h.noise,
            "floor": f"{h.floor_scale:.3g} uT, sources {h.floor_depth:.2f} m below",
            "ceiling": f"{h.ceiling_scale:.3g} uT, sources {h.ceiling_depth:.2f} m above",
            "scales of a tile": LOCAL if learnt.local.spread else "those of the map",
            "hyperparameters": learnt.origin.learning.described,
            "shortest wave (m)": float(2 * np.pi / learnt.resolution.floor),
            "sources": described(learnt),
            "survey's sensors": IN_SIGMAS if learnt.suite else "taken as exact",
            "survey's poses": IN_SIGMAS if learnt.poses else "taken as exact",
            "field": judged(learnt.origin.explanation),
            "tiles": len(learnt.tiling),
            "tile (m)": float(learnt.tiling.grid.size),
        },
        doubts=doubts(learnt),
    )


def described(learnt: Learnt) -> str:
    """Return where the sources came from, in a few words."""
    shown, given = int(np.count_nonzero(learnt.strengths)), len(learnt.strengths)
    if learnt.origin.searched:
        return (
            f"{shown} found without a point cloud: sigmas are less sure; --structure "
            "gives the positions of steel"
        )
    if not given:
        return "floor and ceiling only"
    return f"the readings show {shown} of {given} structures"


def doubts(learnt: Learnt) -> tuple[str, ...]:
    """Return reasons to doubt the map, a sentence each."""
    origin, parts = learnt.origin, learnt.tiling.parts
    found = [each for each in (*origin.survey, narrow(learnt.readings.points)) if each]
    if origin.explanation.reasons:
        found.append(judged(origin.explanation))
    if not origin.explanation.judged:
        found.append("there are too few places to determine whether the map explains the field")
    if origin.searched:
        found.append(
            "sources were searched for, for want of a point cloud of the structure: sigmas are "
            "less sure"
        )
    if parts > 1:
        found.append(
            f"the survey lies in {parts} separate parts; between them nothing is known of the field"
        )
    return tuple(found)


def judged(explanation: Explanation) -> str:
    """Return whether the map explains its readings, in a few words."""
    if explanation.reasons:
        return f"the map does not explain the field: {'; '.join(explanation.reasons)}"
    if not explanation.judged:
        return "too few places to hold any out"
    return f"explained: errors at held-out places are {explanation.spread:.2f} times their sigmas"
