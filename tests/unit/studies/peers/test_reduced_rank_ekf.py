"""The reduced-rank Kalman filter against what was published of it, on the same recordings."""

from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.data import Trajectory
from l2m_gtsam.studies.peers.reduced_rank_ekf import ReducedRankEkfOptions, reduced_rank_ekf
from l2m_gtsam.studies.slam.recordings import SHIP, DriftRecipe, Form, drifted, ship_run

PUBLISHED = {1: (1.91, 0.58, 0.53, 0.09), 2: (1.45, 0.39, 0.52, 0.11)}
"""Rms of dead reckoning and of the filter in metres, each with its spread, by run."""
# With this noise of a step dead reckoning has the published spread; the published program has
# 3.2 mm, of which a spread of 0.06 m follows.
NOISE_M = float(np.sqrt(1e-3))


def rms(odometry: Trajectory, p: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((odometry.p - p) ** 2, axis=1))))


@pytest.mark.parametrize("run", [1, pytest.param(2, marks=pytest.mark.study)])
def test_figures_are_the_published_ones(shared_data: Path, run: int) -> None:
    drive = ship_run(shared_data / SHIP, run)
    box = np.stack([drive.truth.p.min(axis=0), drive.truth.p.max(axis=0)])
    alone, filtered = [], []
    for seed in range(10):
        odometry = drifted(drive.truth, DriftRecipe(level_m=NOISE_M), Form.WORLD, seed)
        found = reduced_rank_ekf(odometry, drive.field, box, ReducedRankEkfOptions())
        alone.append(rms(drive.truth, odometry.p))
        filtered.append(rms(drive.truth, found.p))
    reckoned, spread, published, own_spread = PUBLISHED[run]
    # Means of ten of ours and a hundred of theirs: within half of one drive's spread, and within
    # one where theirs is the smaller.
    assert np.mean(alone) == pytest.approx(reckoned, abs=spread / 2)
    assert np.std(alone) == pytest.approx(spread, rel=0.25)
    assert np.mean(filtered) == pytest.approx(published, abs=own_spread)


def test_vehicle_and_world_have_the_same_errors(shared_data: Path) -> None:
    """Without errors of turns both forms are one."""
    truth = ship_run(shared_data / SHIP, 1).truth
    recipe = DriftRecipe(turn_rad=0.0)
    world, vehicle = (drifted(truth, recipe, form, 3) for form in Form)
    np.testing.assert_allclose(world.p, vehicle.p, atol=1e-9)
    np.testing.assert_allclose(world.R, vehicle.R, atol=1e-9)
