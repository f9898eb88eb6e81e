"""Sites of studies that are simulated, mapped and driven in seconds: one row of racks."""

from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.simulate.floor_plan import FloorPlanOptions
from l2m_gtsam.simulate.route import CalibrationRouteOptions
from l2m_gtsam.simulate.scenario import ScenarioOptions
from l2m_gtsam.simulate.sensors import (
    MappingSuiteOptions,
    NoiseOptions,
    SamplingOptions,
    SensorArrayOptions,
)
from l2m_gtsam.studies.basin.cells import BasinOptions
from l2m_gtsam.studies.site import SiteOptions
from tests.worlds.quick_maps import quick


def one_row_site(noise: float, kind: str = "harmonic") -> SiteOptions:
    """Return the hall with this noise of its sensors (uT) and a quick map of this kind."""
    hall = ScenarioOptions(
        floor_plan=FloorPlanOptions(length=16.0, width=9.0, rack_rows=1, blocks=1),
        suite=MappingSuiteOptions(lateral=(0.0,)),
        array=SensorArrayOptions(count=1),
        noise=NoiseOptions(field=noise),
        calibration_route=CalibrationRouteOptions(turns=1),
        calibration_sampling=SamplingOptions(field_rate=3.0),
    )
    return SiteOptions(scenario=hall, mapping=MappingOptions(model=quick(kind)))


TINY_BASIN = BasinOptions(
    distortions=1, starts=3, few_starts=2, rings=2, width=1.5, site=one_row_site(0.2)
)
