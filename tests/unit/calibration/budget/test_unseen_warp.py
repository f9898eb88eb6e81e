"""A bend that is not in the graph: what is counted for it is what it does, over many bends."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest

from l2m_gtsam.calibration.budget.processes import Warp
from l2m_gtsam.calibration.budget.search import ProcessInformation, process_information
from l2m_gtsam.calibration.budget.unseen_warp import foretold_warp, unseen_warp
from l2m_gtsam.calibration.joint_information import Rows, joint_information
from l2m_gtsam.data import FloatArray
from tests.support.scenes import scene

READINGS, BEFORE_M = 150, 0.03
SCENE = scene(np.linspace(0.0, 200.0, READINGS))
# In a field that grows steadily a shift of the frame is an H.
PLACES = replace(SCENE, slope=np.broadcast_to(SCENE.slope[0], (READINGS, 3, 3)))
WARP = Warp.of(PLACES)
SPECTRUM = WARP.forms[0].mean(axis=0)


@dataclass(frozen=True)
class Line:
    """Readings of unit noise of a sensor of which H is sought, with what a bend does to them."""

    residual: FloatArray

    @cached_property
    def known(self) -> ProcessInformation:
        """What they say of a bend."""
        every, unit = np.arange(READINGS), np.tile(np.eye(3), (READINGS, 1))
        rows = [Rows(0, np.arange(3), unit, self.residual, every)]
        nothing = np.empty(0)
        joint = joint_information({0: slice(0, 3)}, rows, nothing.reshape(0, 0), nothing)
        settled = [joint.after_step(each) for each in rows]
        white = [np.broadcast_to(np.eye(3), (READINGS, 3, 3))]
        return process_information([WARP], joint, settled, white, PLACES.C)

    @property
    def H(self) -> FloatArray:
        """By how much H is off, the true one being zero, shape (3,)."""
        return -np.asarray(self.residual.reshape(READINGS, 3).mean(axis=0))


FEATURES = (PLACES.C @ WARP.features(np.arange(READINGS))).reshape(3 * READINGS, -1)


def bent(size: float, rng: np.random.Generator) -> Line:
    """Return readings along a frame that is bent by a random bend of this size."""
    weights = size * np.sqrt(SPECTRUM) * rng.standard_normal(len(SPECTRUM))
    return Line(rng.standard_normal(3 * READINGS) - FEATURES @ weights)


def test_moments_are_those_of_all_sizes_one_by_one() -> None:
    known = bent(0.02, np.random.default_rng(1)).known
    found = unseen_warp(known, BEFORE_M)
    information, pull = known.system.information, known.system.pull
    sizes = np.linspace(1e-4, 6 * BEFORE_M, 4000)
    weight, moments, squares = 0.0, np.zeros_like(information), 0.0
    for size in sizes:
        prior = size**2 * SPECTRUM
        inner = np.eye(len(prior)) + prior[:, None] * information
        covariance = np.linalg.solve(inner, np.diag(prior))
        mean = covariance @ pull
        log = 0.5 * pull @ mean - 0.5 * np.linalg.slogdet(inner)[1] - 0.5 * (size / BEFORE_M) ** 2
        weight += (each := float(np.exp(log)))
        moments += each * (covariance + np.outer(mean, mean))
        squares += each * size**2
    slow = known.influence @ (moments / weight) @ known.influence.T
    # Steps of the grid of sizes are 7 % each: an integral of smooth functions by them is
    # good to a thousandth; what is smaller or larger than the grid has less than that.
    np.testing.assert_allclose(found.root @ found.root.T, slow, rtol=5e-3)
    assert found.size_m == pytest.approx(np.sqrt(squares / weight), rel=5e-3)


def test_what_is_foretold_is_what_straight_frames_leave() -> None:
    """In the mean of many drives along a frame that is not bent."""
    rng = np.random.default_rng(3)
    found = [unseen_warp(bent(0.0, rng).known, BEFORE_M) for _ in range(200)]
    counted = np.mean([np.diag(each.root @ each.root.T) for each in found], axis=0)
    foretold = foretold_warp(bent(0.0, rng).known, BEFORE_M)
    # The posterior of the mean pull is not the mean of the posteriors.
    np.testing.assert_allclose(np.diag(foretold.root @ foretold.root.T), counted, rtol=0.3)


def test_what_is_counted_is_what_bends_do() -> None:
    """Over bends of all sizes, squared errors are those of noise and of what is counted."""
    rng, draws = np.random.default_rng(2), 600
    squared, counted = np.zeros(3), np.zeros(3)
    for _ in range(draws):
        line = bent(abs(BEFORE_M * rng.standard_normal()), rng)
        squared += line.H**2 / draws
        counted += np.square(unseen_warp(line.known, BEFORE_M).root).sum(axis=1) / draws
    noise = 1 / READINGS
    assert (squared > 1.5 * noise).all()  # bends matter here
    # 600 squares of errors of a random size: 8 % a standard deviation for each of three.
    np.testing.assert_allclose(squared, noise + counted, rtol=0.25)


def test_readings_that_show_no_bend_leave_little_of_it() -> None:
    """Beside what bends of the size beforehand leave in the mean; a few of these hardly show."""
    quiet = unseen_warp(Line(np.zeros(3 * READINGS)).known, BEFORE_M)
    rng = np.random.default_rng(3)
    known = [bent(BEFORE_M, rng) for _ in range(20)]
    shaken = [unseen_warp(each.known, BEFORE_M) for each in known]
    assert quiet.size_m < 0.6 * np.sqrt(np.mean([each.size_m**2 for each in shaken]))
    spread = np.mean([np.square(each.root).sum() for each in shaken])
    assert np.square(quiet.root).sum() < 0.3 * spread
    assert unseen_warp(known[0].known, 1e-6).size_m < 2e-6
