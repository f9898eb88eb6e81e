"""Who did not converge: sensors that another round would change, and not their neighbours."""

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.joint_information import JointInformation
from l2m_gtsam.calibration.one_key import is_changing
from l2m_gtsam.calibration.uncertain_graph import UncertainProblem
from l2m_gtsam.calibration.uncertain_rounds import still_changing
from l2m_gtsam.solve.rank import Determinacy, RankOptions, determinacy

SCALES = RankOptions()


def rank_test(open_: int) -> Determinacy:
    """A sensor of which the first so many parameters are not determined at all."""
    strength = 100.0 / SCALES.scale()
    strength[:open_] = 0.0
    return determinacy(np.diag(strength), SCALES)


def estimate(t_x: float = 0.0, noise: float = 0.1) -> Estimate:
    distortion = np.tile(np.concatenate([np.eye(3).ravel(), np.zeros(3)]), (2, 1))
    t = np.zeros((2, 3))
    t[0, 0] = t_x
    return Estimate(t, distortion, np.array([noise, 0.1]), np.zeros(2), np.zeros(2))


@dataclass(frozen=True)
class Round:
    """The last graph, as far as it says who still changes."""

    steps: dict[int, float]
    decrement: float = 0.0
    noisy: frozenset[int] = frozenset()
    drive: Any = field(
        default_factory=lambda: SimpleNamespace(
            view=SimpleNamespace(sensors=[0, 1]), tests={0: rank_test(0), 1: rank_test(0)}
        )
    )

    def sigmas(self, sensor: int, _: object) -> float:
        return self.steps[sensor]

    def same_noise(self, _one: object, _other: object, sensor: int) -> bool:
        return sensor not in self.noisy


def changing(last: Round) -> frozenset[int]:
    problem, joint = cast("UncertainProblem", last), cast("JointInformation", last)
    return still_changing(problem, joint, estimate(), estimate(), SCALES)


@pytest.mark.parametrize(
    ("last", "expected"),
    [
        (Round({0: 0.01, 1: 0.02}), set()),
        (Round({0: 0.5, 1: 0.02}, decrement=1.4), {0}),
        (Round({0: 0.01, 1: 0.02}, noisy=frozenset({1})), {1}),
        (Round({0: 0.01, 1: 0.02}, decrement=1.4), {0, 1}),
    ],
)
def test_only_who_still_changes_did_not_converge(last: Round, expected: set[int]) -> None:
    """What sensors share counts against all of them where none has a part in it of its own."""
    assert changing(last) == expected


@pytest.mark.parametrize(
    ("open_", "after", "expected"),
    [
        (0, estimate(), False),
        (0, estimate(t_x=1e-3), True),
        (0, estimate(noise=0.11), True),
        (3, estimate(t_x=0.3), False),
        (3, estimate(noise=0.11), True),
        (2, estimate(t_x=0.3), True),
    ],
)
def test_a_place_that_is_open_may_move(open_: int, after: Estimate, expected: bool) -> None:
    problem = cast("Any", SimpleNamespace(determinacies={0: rank_test(open_), 1: rank_test(0)}))
    assert is_changing(0, problem, estimate(), after, SCALES) is expected
    assert not is_changing(1, problem, estimate(), after, SCALES)


def test_what_is_determined_is_all_but_what_is_not() -> None:
    for open_ in (0, 1, 3, 7):
        found = rank_test(open_)
        assert found.determined.shape == (15 - open_, 15)
        np.testing.assert_allclose(found.determined @ found.determined.T, np.eye(15 - open_))
        np.testing.assert_allclose(found.determined[:, :open_], 0.0, atol=1e-12)
        assert found.place_open == (open_ >= 3)
