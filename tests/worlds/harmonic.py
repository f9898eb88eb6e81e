"""Parts of harmonic maps and a small map of dipoles and a post, for tests of either."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSample, FloatArray
from l2m_gtsam.maps.harmonic import learning
from l2m_gtsam.maps.harmonic.basis import Basis, basis_of
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.family import Family, Hyperparameters, UniformField
from l2m_gtsam.maps.harmonic.frame import TileFrame
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.harmonic.modes import CEILING, FLOOR, modes_up_to
from l2m_gtsam.maps.harmonic.search import SearchOptions
from tests.worlds.exact import DipoleWorld, dipole_world

GIVEN = Hyperparameters(
    floor_scale=3.0,
    floor_depth=0.5,
    ceiling_scale=1.5,
    ceiling_depth=1.2,
    structure_scale=0.4,
    noise=0.2,
)
SIZE = np.array([3.0, 2.5])
TILTED = Rotation.from_euler("xyz", [5.0, -3.0, 20.0], degrees=True).as_matrix()


def places(count: int = 40, seed: int = 0) -> FloatArray:
    """Return places of a tile in its own frame, shape (N, 3)."""
    return np.random.default_rng(seed).uniform([0.2, 0.2, 0.0], [2.8, 2.3, 0.8], (count, 3))


def dipoles() -> Dipoles:
    """Return four combinations of two sources under and beside a tile."""
    rng = np.random.default_rng(1)
    combinations, _ = np.linalg.qr(rng.normal(size=(6, 4)))
    return Dipoles(np.array([[1.0, 1.0, -0.4], [1.5, -0.5, 0.5]]), combinations, 2.0)


FAMILIES: dict[str, Family] = {
    "uniform": UniformField(100.0),
    "floor": modes_up_to(FLOOR, SIZE, 0.0, 5.0),
    "ceiling": modes_up_to(CEILING, SIZE, 0.8, 4.0),
    "dipoles": dipoles(),
}


def basis(R: FloatArray = TILTED) -> Basis:
    """Return all of ``FAMILIES`` in a tile with these axes."""
    frame = TileFrame(R, np.array([10.0, -20.0, 0.3]), SIZE, 0.8)
    return Basis(frame, tuple(FAMILIES.values()))


WORLD = dipole_world(1)
# Of maps of that world; GIVEN is of the families alone.
PRIOR = Hyperparameters(
    floor_scale=1.6, floor_depth=0.7, ceiling_scale=0.5, ceiling_depth=1.4, noise=0.2
)
NO_SEARCH = SearchOptions(rounds=0)
# Coarse and fast.
OPTIONS = HarmonicOptions(hyperparameters=PRIOR, search=NO_SEARCH, modes=200, mode_share=0.5)
POST = np.column_stack([np.full(20, 0.3), np.full(20, 1.6), np.linspace(0, 1.5, 20)])
STEEL = DipoleWorld(np.zeros(3), POST[::4], np.random.default_rng(6).normal(0, 6, (5, 3)))


def readings(count: int = 600, seed: int = 0, east: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Return places and noisy fields of a survey of ``WORLD`` and the post, shape (N, 3) each."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([east - 1.5, -1.2, 0.2], [east + 1.5, 1.2, 0.8], (count, 3))
    field = WORLD.field_and_gradient(points)[0] + STEEL.field_and_gradient(points)[0]
    return points, field + rng.normal(0, PRIOR.noise, field.shape)


def queries(count: int = 300) -> FloatArray:
    """Return places in and around the survey, shape (N, 3)."""
    return np.random.default_rng(5).uniform([-3, -3, -0.3], [3, 3, 1.5], (count, 3))


def within_survey(count: int = 300) -> FloatArray:
    """Return places well inside the survey, shape (N, 3)."""
    return np.random.default_rng(6).uniform([-1.4, -1.1, 0.2], [1.4, 1.1, 0.8], (count, 3))


@cache
def fitted_map() -> HarmonicMap:
    """Return a map of ``readings``, coarse and fast, with structure that has a field."""
    ours = HarmonicMap.fit(*readings(), OPTIONS, POST)
    assert ours.learnt.strengths.max() > 0
    return ours


def refuse_large_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail at once where a window would have thousands of modes: minutes and gigabytes."""

    def checked(*arguments: Any) -> Basis:
        basis = basis_of(*arguments)
        assert len(basis) < 2000
        return basis

    monkeypatch.setattr(learning, "basis_of", checked)


def rms(values: FloatArray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def assert_same(one: FieldSample, other: FieldSample, tolerance: float) -> None:
    """Assert that two answers agree to a tolerance, relative or absolute."""
    np.testing.assert_array_equal(one.inside, other.inside)
    for name in ("field", "gradient", "variance"):
        np.testing.assert_allclose(
            getattr(one, name), getattr(other, name), rtol=tolerance, atol=tolerance
        )
