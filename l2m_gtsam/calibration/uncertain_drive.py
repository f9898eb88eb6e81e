"""What all rounds of the last stage have in common: readings, the map, and shared errors."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.budget.found import NOTHING_FOUND, Budget
from l2m_gtsam.calibration.coverage import Coverage, UncertainMap, cover
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.moving_fields import moving_fields
from l2m_gtsam.calibration.view import QueryableMap, View
from l2m_gtsam.data import FloatArray


def starting_values(estimate: Estimate, sensors: list[int], coverage: Coverage) -> gtsam.Values:
    """Return all variables of the graph, with no error of map or poses."""
    values = estimate.values(sensors)
    for key, size in coverage.sizes.items():
        values.insert(key, np.zeros(size))
    return values


@dataclass(frozen=True)
class WeightsPrior:
    """What is known of shared errors before any reading: the same in all rounds.

    Attributes
    ----------
    coverage
        The errors.
    graph
        Their prior as factors.
    information
        The same as a matrix, shape (K, K).
    """

    coverage: Coverage
    graph: gtsam.NonlinearFactorGraph
    information: FloatArray

    @property
    def sizes(self) -> dict[int, int]:
        """Number of weights of each key."""
        return self.coverage.sizes

    @classmethod
    def of(cls, coverage: Coverage) -> "WeightsPrior":
        """Return the prior of the weights of a coverage."""
        tiles = coverage.tile_information
        information = np.zeros((sum(coverage.sizes.values()),) * 2)
        information[: len(tiles), : len(tiles)] = tiles
        if beside := list(coverage.sizes.items())[len(coverage.tiles) :]:
            zero, ordering = gtsam.Values(), gtsam.Ordering()
            for key, size in beside:
                zero.insert(key, np.zeros(size))
                ordering.push_back(key)
            linear = coverage.prior_beside_tiles().linearize(zero)
            information[len(tiles) :, len(tiles) :], _ = linear.hessian(ordering)
        return cls(coverage, coverage.prior(), information)


@dataclass(frozen=True)
class UncertainDrive:
    """What all rounds have in common: readings, the map, and the errors that readings share."""

    view: View
    field_map: QueryableMap
    prior: WeightsPrior

    @property
    def budget(self) -> Budget:
        """Processes that its graph has."""
        return self.prior.coverage.budget

    @classmethod
    def of(
        cls,
        view: View,
        field_map: QueryableMap,
        errors: UncertainMap,
        near: Estimate,
        options: OneKeyOptions,
        budget: Budget = NOTHING_FOUND,
    ) -> "UncertainDrive":
        """Return what readings share where an estimate puts them."""
        view = replace(view, readings=budget.on(view.readings))
        coverage = cover(view, errors, near, budget.lasting(options.pose_noise.lasting_s))
        moving = moving_fields(view.readings, options.moving_field_ut)
        coverage = replace(coverage, moving=moving, budget=budget)
        return cls(view, field_map, WeightsPrior.of(coverage))

    def beside(self, budget: Budget) -> "UncertainDrive":
        """Return the same with processes that are no errors of poses, and the map as it was asked.

        Errors of poses cut a drive at other knots, for which the map has to be asked again.
        """
        coverage = replace(self.prior.coverage, budget=budget)
        return replace(self, prior=WeightsPrior.of(coverage))
