"""A simulated hall on disk: what `l2m simulate` writes is what `l2m map build` takes."""

from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.batch.maps import build_map_file
from l2m_gtsam.batch.simulation import STRUCTURE_FILE, SUITE_FILE, simulate_bags
from l2m_gtsam.config import Config
from l2m_gtsam.data import FloatArray
from l2m_gtsam.progress import silent
from l2m_gtsam.simulate.bag_writer import BagKind
from l2m_gtsam.simulate.floor_plan import FloorPlanOptions
from l2m_gtsam.simulate.route import CalibrationRouteOptions
from l2m_gtsam.simulate.scenario import Scenario, ScenarioOptions, simulate
from l2m_gtsam.simulate.sensors import MappingSuiteOptions, SamplingOptions, SensorArrayOptions
from l2m_gtsam.storage.cloud import read_cloud
from tests.worlds.quick_maps import QUICK_HARMONIC

SMALL = ScenarioOptions(
    floor_plan=FloorPlanOptions(length=12.0, width=8.0, rack_rows=1, blocks=1),
    suite=MappingSuiteOptions(lateral=(-0.3, 0.3), heights=(0.0,)),
    mapping_sampling=SamplingOptions(field_rate=4.0),
    array=SensorArrayOptions(count=1),
    calibration_route=CalibrationRouteOptions(turns=1),
    calibration_sampling=SamplingOptions(field_rate=1.0),
)
CONFIG = Config.model_validate({"mapping": {"model": {"harmonic": QUICK_HARMONIC}}})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hall")


@pytest.fixture(scope="module")
def hall(folder: Path) -> Scenario:
    return simulate_bags(folder, SMALL, [BagKind.MCAP], silent)


def test_the_structure_on_disk_is_that_of_the_world(hall: Scenario, folder: Path) -> None:
    np.testing.assert_array_equal(read_cloud(folder / STRUCTURE_FILE), hall.cloud)
    assert hall.cloud[:, 2].min() > -5 * SMALL.structure.noise  # nothing of what is buried
    assert len(hall.cloud) > 1000


def test_the_same_seed_gives_the_same_structure(hall: Scenario) -> None:
    again = simulate(SMALL)
    np.testing.assert_array_equal(again.cloud, hall.cloud)
    other = simulate(SMALL.model_copy(update={"seed": 2}))
    assert other.cloud.shape != hall.cloud.shape or (other.cloud != hall.cloud).any()


def test_what_the_lidar_sees_leaves_all_else_as_it_was(hall: Scenario) -> None:
    """A stream of randomness of its own."""
    finer = SMALL.model_copy(
        update={"structure": SMALL.structure.model_copy(update={"spacing": 0.2})}
    )
    other = simulate(finer)
    assert len(other.cloud) < len(hall.cloud)
    for one, same in zip(
        hall.mapping.recording.series, other.mapping.recording.series, strict=True
    ):
        np.testing.assert_array_equal(one.field, same.field)


def near_steel(hall: Scenario, count: int = 400) -> FloatArray:
    """Places of the survey, a little beside it, nearest to the steel."""
    p = hall.mapping.recording.trajectory.p
    away = np.array([np.linalg.norm(hall.cloud - each, axis=1).min() for each in p[::20]])
    nearest = p[::20][np.argsort(away)[:count]]
    return np.asarray(nearest + np.random.default_rng(1).uniform(-0.1, 0.1, nearest.shape))


def test_the_map_is_better_with_the_structure(hall: Scenario, folder: Path) -> None:
    bag, suite = folder / "mapping_mcap", folder / SUITE_FILE
    at = near_steel(hall)
    truth = hall.world.field(at)
    errors = []
    for cloud in (None, str(folder / STRUCTURE_FILE)):
        built = build_map_file([bag], folder / "map.npz", CONFIG, suite, silent, cloud)
        sample = built.field_map.query(at)
        errors.append(np.sqrt(np.mean((sample.field - truth)[sample.inside] ** 2)))
    assert errors[1] < 0.7 * errors[0]
