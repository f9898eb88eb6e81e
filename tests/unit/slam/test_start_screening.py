"""A lattice of places: nothing that can be true is ruled out, and scores are what they say."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.slam.options import StartSearchOptions
from l2m_gtsam.slam.start.screening import (
    LARGEST,
    MOST_KEPT,
    FieldLattice,
    Rules,
    about_z,
    heading,
    heading_step,
    lattice_over,
    row_of,
    score_at,
    screen,
)
from l2m_gtsam.slam.start.window import Pattern
from tests.worlds.surveyed import SurveyedWorld, strange_hall, surveyed

STEP = 0.2
TILT = 0.03
ANYTHING = Rules(np.inf, 1000, TILT**2)


@pytest.fixture(scope="module")
def hall() -> SurveyedWorld:
    return surveyed(strange_hall(1))


@pytest.fixture(scope="module")
def lattice(hall: SurveyedWorld) -> FieldLattice:
    return lattice_over(hall, hall.readings, STEP)


def pattern_at(
    hall: SurveyedWorld, p: FloatArray, yaw: float, rng: np.random.Generator, noise: float = 0.1
) -> Pattern:
    """Return a window of two metres that was driven about a place, its noise as it says."""
    way = np.linspace(-1, 1, 25)
    x = np.column_stack([way, 0.4 * np.sin(2 * way), 0.05 * np.cos(9 * way)])
    x -= x[12]
    field, _ = hall.field_and_gradient(x @ about_z(yaw).T + p)
    field = field @ about_z(yaw) + noise * rng.normal(size=x.shape)
    return Pattern(x, field, np.full(len(x), noise**2), np.zeros(len(x)), TILT, np.zeros(3))


def nearest(lattice: FieldLattice, p: FloatArray) -> int:
    """Return the node nearest to a place."""
    return int(np.linalg.norm(lattice.places(np.arange(len(lattice))) - p, axis=1).argmin())


def squared(pattern: Pattern, hall: SurveyedWorld, p: FloatArray, yaw: float) -> float:
    """Return what the readings leave at the truth, in sigmas squared."""
    field, _ = hall.field_and_gradient(pattern.x @ about_z(yaw).T + p)
    e = pattern.field @ about_z(yaw).T - field
    return float(np.sum(e**2 / pattern.variance[:, None]))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000))
def test_the_node_next_to_the_truth_is_not_ruled_out(
    hall: SurveyedWorld, lattice: FieldLattice, seed: int
) -> None:
    """Its score is no more than what the truth leaves, and one for each reading."""
    rng = np.random.default_rng(seed)
    p = np.append(rng.uniform(-3, 3, 2), rng.uniform(0.1, 0.9))
    yaw = float(rng.uniform(-np.pi, np.pi))
    pattern = pattern_at(hall, p, yaw, rng)
    turn = heading_step(pattern.radius, STEP)
    near = turn * np.round(yaw / turn)
    at = lattice.at[nearest(lattice, p)]
    score = score_at(at, lattice.nodes, heading(pattern, STEP, near, turn), ANYTHING)
    assert score <= squared(pattern, hall, p, yaw) + len(pattern.x)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_a_score_is_the_least_over_the_tilt(lattice: FieldLattice, seed: int) -> None:
    """Against least squares over all readings, written out; nothing is far off here."""
    rng = np.random.default_rng(seed)
    node = int(rng.integers(len(lattice)))
    x = rng.uniform(-0.4, 0.4, (12, 3)) * [1, 1, 0.2]
    field = lattice.nodes.field[node] + rng.normal(0, 1, (12, 3))
    pattern = Pattern(x, field, np.full(12, 1.0), np.full(12, 0.1), TILT, np.zeros(3))
    laid = heading(pattern, STEP, 0.3, 0.05)
    rows, rhs = [np.eye(2) / TILT], [np.zeros(2)]
    total = 0.0
    for n in range(12):
        row = row_of(lattice.nodes.rows, lattice.at[node], laid.node[n])
        if row < 0:
            total += 4.0
            continue
        b = lattice.nodes.field[row] + lattice.nodes.gradient[row] @ laid.rest[n]
        tau = (
            lattice.nodes.slope[row] * laid.moved[n] + laid.turned[n] + lattice.nodes.curvature[row]
        )
        s2 = 1.0 + lattice.nodes.variance[row] + lattice.nodes.slope[row] ** 2 * 0.01 + tau**2
        f = laid.field[n]
        if np.sum((f - b) ** 2) > (LARGEST + 1) * (s2 + TILT**2 * (f @ f + f[2] ** 2)):
            total += LARGEST + 1
            continue
        turned = np.cross(np.eye(3)[:2], f)
        rows.append(turned.T / np.sqrt(s2))
        rhs.append((b - f) / np.sqrt(s2))
    A, y = np.concatenate(rows), np.concatenate(rhs)
    tilt = np.linalg.lstsq(A, y)[0]
    total += float(np.sum((y - A @ tilt) ** 2))
    found = score_at(lattice.at[node], lattice.nodes, laid, ANYTHING)
    assert found == pytest.approx(total, rel=1e-9)


def test_a_score_beyond_the_limit_is_given_up(hall: SurveyedWorld, lattice: FieldLattice) -> None:
    """Sums of the first readings only grow: what is given up early is what is beyond at the end."""
    rng = np.random.default_rng(3)
    laid = heading(pattern_at(hall, np.array([0.5, 0.2, 0.5]), 0.4, rng), STEP, 0.0, 0.1)
    nodes, limit = lattice.nodes, 150.0
    for at in lattice.at[rng.choice(len(lattice), 300, replace=False)]:
        whole = score_at(at, nodes, laid, ANYTHING)
        part = score_at(at, nodes, laid, Rules(limit, 1000, TILT**2))
        assert part == (whole if whole <= limit else np.inf)


def test_places_are_screened(hall: SurveyedWorld, lattice: FieldLattice) -> None:
    """The best of half a million places come first, and the true one is among them."""
    p, yaw = np.array([1.3, -0.7, 0.5]), 2.0
    pattern = pattern_at(hall, p, yaw, np.random.default_rng(5))
    found = screen(pattern, lattice, np.arange(len(lattice)), StartSearchOptions())
    assert found.looked_at > 100_000
    assert len(found.places) <= MOST_KEPT
    assert (np.diff(found.places.score) >= 0).all()
    best = found.places[np.arange(20)]
    assert np.linalg.norm(best.p - p, axis=1).min() < STEP


def test_headings_are_as_fine_as_the_window_is_wide() -> None:
    for radius in (0.0, 0.5, 3.0, 20.0):
        angle = heading_step(radius, STEP)
        assert angle * max(radius, STEP) <= STEP + 1e-12
        assert angle <= np.deg2rad(10) + 1e-12
        assert 2 * np.pi / angle == pytest.approx(round(2 * np.pi / angle), abs=1e-9)


def test_a_lattice_knows_the_field_about_its_nodes(
    hall: SurveyedWorld, lattice: FieldLattice
) -> None:
    """Within a cell the field is no further from the tangent than is told, almost everywhere."""
    rng = np.random.default_rng(7)
    nodes = rng.choice(len(lattice), 2000)
    off = rng.uniform(-STEP / 2, STEP / 2, (len(nodes), 3))
    field, _ = hall.field_and_gradient(lattice.places(nodes) + off)
    tangent = lattice.nodes.field[nodes] + np.einsum(
        "nij,nj->ni", lattice.nodes.gradient[nodes], off
    )
    missed = np.linalg.norm(field - tangent, axis=1)
    # Neighbours are six directions; between them a field may bend a little more.
    assert np.mean(missed <= lattice.nodes.curvature[nodes]) > 0.98


def test_a_map_that_is_too_large_is_refused(hall: SurveyedWorld) -> None:
    far = TrainingSet(
        hall.readings.points * [200, 200, 1], hall.readings.field, hall.readings.weight
    )
    with pytest.raises(MapError, match=r"choose a larger slam\.start\.search\.step_m"):
        lattice_over(replace(hall, readings=far), far, STEP)
