"""The scaling study as cells, page and figures: ``l2m study scaling``."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from matplotlib.figure import Figure

from l2m_gtsam.studies.scaling.figure import scaling_figure
from l2m_gtsam.studies.scaling.measurements import Part, ScalingCell, ScalingOptions, Way
from l2m_gtsam.studies.scaling.page import scaling_page
from l2m_gtsam.studies.scaling.table import ScalingTable, scaling_table
from l2m_gtsam.studies.scaling.tasks import (
    MappedDrive,
    mapped_drive,
    measured_map,
    measured_solves,
    warmed,
)
from l2m_gtsam.studies.scaling.workers import measured_workers
from l2m_gtsam.studies.site import Surveyed, surveyed
from l2m_gtsam.studies.study import Study

Place = Surveyed | MappedDrive | None


def keys(options: ScalingOptions) -> tuple[str, ...]:
    """Return a cell for each size of each quantity, workers last: quantity, way, size."""
    maps = ((Way.HARMONIC, options.survey), (Way.SLIDING, options.survey))
    return (
        *(f"{Part.READINGS}-{size:05d}" for size in options.readings),
        *(f"{Part.SENSORS}-{size:02d}" for size in options.sensors),
        *(
            f"{Part.SURVEY}-{way.name.lower()}-{size:05d}"
            for way, sizes in (*maps, (Way.DENSE, options.dense))
            for size in sizes
        ),
        *(f"{Part.WORKERS}-{count:02d}" for count in options.workers),
    )


def site(options: ScalingOptions, key: str) -> str:
    """Return the quantity: all its cells share a place."""
    return key.partition("-")[0]


def prepare(options: ScalingOptions, name: str) -> Place:
    """Return what the cells of a quantity share."""
    match Part(name):
        case Part.READINGS:
            return warmed(options, mapped_drive(options, hall(options), 1, options.rate))
        case Part.SENSORS:
            rate = options.site.scenario.calibration_sampling.field_rate
            work = mapped_drive(options, hall(options), max(options.sensors), rate)
            return warmed(options, work)
        case Part.SURVEY:
            return hall(options)
        case Part.WORKERS:
            return None


@lru_cache(maxsize=1)
def hall(options: ScalingOptions) -> Surveyed:
    """Return world and survey; made once in each process."""
    return surveyed(options.site)


def compute(options: ScalingOptions, key: str, place: Any) -> ScalingCell:
    """Measure one size."""
    part, *way, size = key.split("-")
    count = int(size)
    match Part(part):
        case Part.READINGS:
            numeric = count <= options.numeric_readings
            work = place.thinned(count)
            measured = measured_solves(options, Part.READINGS, len(work.readings), work, numeric)
        case Part.SENSORS:
            numeric = count <= options.numeric_sensors
            work = place.first(count).thinned(options.each)
            measured = measured_solves(options, Part.SENSORS, count, work, numeric)
        case Part.SURVEY:
            measured = (measured_map(options, Way[way[0].upper()], count, place),)
        case Part.WORKERS:
            measured = measured_workers(options, count)
    return ScalingCell(measured)


def summarise(options: ScalingOptions, cells: Mapping[str, ScalingCell]) -> ScalingTable:
    """Join all measurements."""
    return scaling_table(options, [each for cell in cells.values() for each in cell.measurements])


def figures(table: ScalingTable) -> dict[str, Figure]:
    """Return the curves as a picture."""
    return {"scaling": scaling_figure(table)}


SCALING = Study(
    name="scaling",
    title="How time grows",
    options=ScalingOptions,
    size=frozenset({"readings", "survey", "dense", "workers"}),
    cell=ScalingCell,
    summary=ScalingTable,
    keys=keys,
    site=site,
    prepare=prepare,
    compute=compute,
    summarise=summarise,
    page=scaling_page,
    figures=figures,
)
