"""The basin study as cells, page and figure: ``l2m study basin``."""

from collections.abc import Mapping

from matplotlib.figure import Figure

from l2m_gtsam.studies.basin.cells import (
    BasinOptions,
    BasinTable,
    DistortionCells,
    basin_table,
    cells_of,
)
from l2m_gtsam.studies.basin.report import basin_figure, basin_page
from l2m_gtsam.studies.site import Site, mapped_site
from l2m_gtsam.studies.study import Study


def keys(options: BasinOptions) -> tuple[str, ...]:
    """Return one cell for each distortion."""
    return tuple(f"distortion-{number:03d}" for number in range(options.distortions))


def site(options: BasinOptions, key: str) -> str:
    """Return the only place."""
    return "warehouse"


def prepare(options: BasinOptions, name: str) -> Site:
    """Return the place."""
    return mapped_site(options.site)


def compute(options: BasinOptions, key: str, place: Site) -> DistortionCells:
    """Calibrate one sensor from all its starts."""
    return cells_of(options, place, int(key.rpartition("-")[2]))


def summarise(options: BasinOptions, cells: Mapping[str, DistortionCells]) -> BasinTable:
    """Count."""
    return basin_table(options, [ring for each in cells.values() for ring in each.rings])


def figures(table: BasinTable) -> dict[str, Figure]:
    """Return the success rates as a picture."""
    return {"basin": basin_figure(table)}


BASIN = Study(
    name="basin",
    title="How far off may a guess be?",
    options=BasinOptions,
    size=frozenset({"distortions"}),
    cell=DistortionCells,
    summary=BasinTable,
    keys=keys,
    site=site,
    prepare=prepare,
    compute=compute,
    summarise=summarise,
    page=basin_page,
    figures=figures,
)
