"""The ablation study: its errors and comparisons, and the whole of it at a tiny size."""

from pathlib import Path

import pytest

from l2m_gtsam.cluster import ClusterOptions
from l2m_gtsam.config import MappingOptions
from l2m_gtsam.simulate.floor_plan import FloorPlanOptions
from l2m_gtsam.simulate.route import CalibrationRouteOptions
from l2m_gtsam.simulate.scenario import ScenarioOptions
from l2m_gtsam.simulate.sensors import ArrayOptions, NoiseOptions, SamplingOptions, SuiteOptions
from l2m_gtsam.studies.ablation import AblationOptions, Solver
from l2m_gtsam.studies.ablation_study import ABLATION
from l2m_gtsam.studies.ablation_table import AblationTable
from l2m_gtsam.studies.map_picture import WindowOptions
from l2m_gtsam.studies.run import run_study
from l2m_gtsam.studies.site import SiteOptions
from tests.quick_maps import quick

HALL = ScenarioOptions(
    floor_plan=FloorPlanOptions(length=16.0, width=9.0, rack_rows=1, blocks=1),
    suite=SuiteOptions(lateral=(0.0,)),
    array=ArrayOptions(count=1),
    noise=NoiseOptions(field=0.5),
    calibration_route=CalibrationRouteOptions(turns=1),
    calibration_sampling=SamplingOptions(field_rate=3.0),
)
TINY = AblationOptions(
    batches=1,
    batch=2,
    spacings=(0.0, 1.5),
    window=WindowOptions(width=4.0, height=3.0, step=0.5),
    site=SiteOptions(scenario=HALL, mapping=MappingOptions(model=quick("harmonic"))),
)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("ablation")


@pytest.fixture(scope="module")
def table(out: Path) -> AblationTable:
    cluster = ClusterOptions(workers=1)
    return run_study(ABLATION, TINY, out, cluster, lambda *_: None, "l2m study ablation").summary


def test_every_combination_is_there(table: AblationTable) -> None:
    assert len(table.rows) == 2 * 3 * len(Solver)
    for row in table.rows:
        assert row.calibrations == 2
