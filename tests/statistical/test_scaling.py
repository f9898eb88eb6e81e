"""The scaling study: its exponents and ratios, and the whole of it at a tiny size."""

import pytest

from l2m_gtsam.cluster import ClusterOptions
from l2m_gtsam.config import MappingOptions
from l2m_gtsam.studies.run import run_study
from l2m_gtsam.studies.scaling import Part, ScalingOptions, Way
from l2m_gtsam.studies.scaling_study import SCALING
from l2m_gtsam.studies.scaling_table import ScalingTable
from l2m_gtsam.studies.site import SiteOptions
from tests.quick_maps import quick
from tests.statistical.test_ablation import HALL

SITE = SiteOptions(scenario=HALL, mapping=MappingOptions(model=quick("harmonic")))
TINY = ScalingOptions(
    readings=(60, 120),
    numeric_readings=60,
    sensors=(1,),
    each=60,
    survey=(300, 600),
    dense=(100, 200),
    workers=(1,),
    calibrations=2,
    rounds=1,
    rate=4.0,
    site=SITE,
    small_site=SITE,
)


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> ScalingTable:
    out = tmp_path_factory.mktemp("scaling")
    cluster = ClusterOptions(workers=1)
    return run_study(SCALING, TINY, out, cluster, lambda *_: None, "l2m study scaling").summary


def test_every_size_is_timed(table: ScalingTable) -> None:
    assert {(each.part, each.way) for each in table.curves} == {
        *((part, way) for part in (Part.READINGS, Part.SENSORS) for way in (Way.POINT, Way.FULL)),
        (Part.READINGS, Way.NUMERIC),
        (Part.SENSORS, Way.NUMERIC),
        *((Part.SURVEY, way) for way in (Way.HARMONIC, Way.SLIDING, Way.DENSE)),
        *((Part.WORKERS, way) for way in (Way.BATCH, Way.STARTED)),
    }
