"""Potentials of the harmonic families, written out: the field is their gradient."""

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.family import Family
from l2m_gtsam.maps.harmonic.modes import Modes


def potential(of: Family, points: FloatArray, weights: FloatArray) -> FloatArray:
    """Potential at points of a family's own frame, shape (N,), in uT m."""
    if isinstance(of, Modes):
        waves = np.cos(points[:, None, :2] * np.pi * of.numbers / of.size).prod(axis=2)
        return np.asarray((waves * np.exp((points[:, 2:] - of.z) * of.kz)) @ weights)
    if isinstance(of, Dipoles):
        r = points[:, None, :] - of.positions
        moments = (of.combinations @ weights).reshape(-1, 3)
        cubes = np.linalg.norm(r, axis=2) ** 3
        return np.asarray(-np.sum(np.einsum("nki,ki->nk", r, moments) / cubes, axis=1))
    return points @ weights


def potential_of_basis(of: Basis, points: FloatArray, weights: FloatArray) -> FloatArray:
    """Potential of all families at points of the map frame, shape (N,), in uT m."""
    local = (points - of.frame.corner) @ of.frame.R_map_tile
    parts = zip(of.families, of.columns, strict=True)
    return np.asarray(sum(potential(f, local, weights[columns]) for f, columns in parts))


def features(of: Family, points: FloatArray) -> FloatArray:
    """Field of each function of a family by itself, shape (N, 3, m), in uT."""
    rows = np.empty((len(of), 3, len(points)))
    of.write_rows(points, np.ones(len(of)), rows)
    return rows.transpose(2, 1, 0)
