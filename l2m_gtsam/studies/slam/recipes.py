"""How an odometry is made of true poses, as the publication on the model ship does.

Each step gets white noise and the same small drift, each turn white noise. Steps are put together
in one of two forms: along the axes of the world, so that headings drift beside positions that know
nothing of it, or as the vehicle sees them, so that a wrong heading turns all later steps.
"""

from dataclasses import replace
from enum import StrEnum

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.options import Options


class Form(StrEnum):
    """How drifted steps are put together."""

    WORLD = "world"
    VEHICLE = "vehicle"


class DriftRecipe(Options):
    """Errors of every step."""

    level_m: float = Field(default=float(np.sqrt(1e-5)), ge=0)
    """White noise of a step along x and y of the world,"""
    vertical_m: float = Field(default=float(np.sqrt(1e-7)), ge=0)
    """along z, metres,"""
    turn_rad: float = Field(default=float(np.sqrt(1e-5)), ge=0)
    """and of its turn about each axis."""
    drift_m: float = Field(default=0.003)
    """What every step is too long by along x and along y of the world."""


def drifted(truth: Trajectory, recipe: DriftRecipe, form: Form, seed: int) -> Trajectory:
    """Return an odometry of a drive, which begins at the true pose.

    Parameters
    ----------
    truth
        N true poses.
    recipe
        Errors of each step between them.
    form
        How the steps are put together; their errors are the same.
    seed
        Of the noise.
    """
    rng, count = np.random.default_rng(seed), len(truth) - 1
    sigma = np.array([recipe.level_m, recipe.level_m, recipe.vertical_m])
    steps = np.diff(truth.p, axis=0) + sigma * rng.normal(size=(count, 3))
    steps += np.array([recipe.drift_m, recipe.drift_m, 0.0])
    errors = Rotation.from_rotvec(recipe.turn_rad * rng.normal(size=(count, 3))).as_matrix()
    back = truth.R[:-1].transpose(0, 2, 1)
    if form is Form.WORLD:
        own = chained(truth.R[0], errors @ truth.R[1:] @ back)
    else:  # the transposes of a chain along the vehicle's axes are one along fixed axes
        turns = back @ errors @ truth.R[1:]
        own = chained(truth.R[0].T, turns.transpose(0, 2, 1)).transpose(0, 2, 1)
        steps = np.einsum("nij,njk,nk->ni", own[:-1], back, steps)
    p = truth.p[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return replace(truth, R=own, p=p, covariance=None)


def chained(R: FloatArray, turns: FloatArray) -> FloatArray:
    """Return rotations, each the one before turned about fixed axes, shape (N, 3, 3)."""
    found = [R]
    for turn in turns:
        found.append(turn @ found[-1])
    return np.stack(found)
