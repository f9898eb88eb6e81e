"""The ablation study as cells, page and figures: ``l2m study ablation``."""

from collections.abc import Mapping

from matplotlib.figure import Figure

from l2m_gtsam.studies.ablation.boxes import box_figure
from l2m_gtsam.studies.ablation.cells import (
    AblationCell,
    AblationOptions,
    AblationPlace,
    ablation_batch,
    ablation_place,
)
from l2m_gtsam.studies.ablation.map_picture import map_picture
from l2m_gtsam.studies.ablation.maps import map_figure
from l2m_gtsam.studies.ablation.page import ablation_page
from l2m_gtsam.studies.ablation.table import AblationTable, ablation_table
from l2m_gtsam.studies.study import Study

PICTURE = "map"
LOOKED_AT = 4  # drives along which a map is compared with the world


def keys(options: AblationOptions) -> tuple[str, ...]:
    """Return a picture and batches for each map: kind, number of the density, which cell."""
    cells = [PICTURE, *(f"{number:03d}" for number in range(options.batches))]
    return tuple(
        f"{kind}-{density}-{cell}"
        for density in range(len(options.spacings))
        for kind in options.kinds
        for cell in cells
    )


def site(options: AblationOptions, key: str) -> str:
    """Return the map: kind and number of the density."""
    return key.rpartition("-")[0]


def prepare(options: AblationOptions, name: str) -> AblationPlace:
    """Return the map with the drives through it."""
    return ablation_place(options, *map_of(options, name))


def compute(options: AblationOptions, key: str, place: AblationPlace) -> AblationCell:
    """Draw the map, or calibrate a batch of sensors on it."""
    cell = key.rpartition("-")[2]
    if cell != PICTURE:
        return AblationCell(batch=ablation_batch(options, place, int(cell)))
    hall = place.hall
    drives = hall.drives[:LOOKED_AT]
    picture = map_picture(place.field_map, hall.part, hall.floor, drives, options.window)
    return AblationCell(picture=picture)


def summarise(options: AblationOptions, cells: Mapping[str, AblationCell]) -> AblationTable:
    """Join the batches of each map."""
    names = dict.fromkeys(site(options, key) for key in cells)
    parts = {
        map_of(options, name): [cells[key] for key in cells if site(options, key) == name]
        for name in names
    }
    return ablation_table(options, parts)


def map_of(options: AblationOptions, name: str) -> tuple[str, float]:
    """Return kind and spacing of a map by name."""
    kind, _, density = name.rpartition("-")
    return kind, options.spacings[int(density)]


def figures(table: AblationTable) -> dict[str, Figure]:
    """Return errors and maps as pictures."""
    return {"ablation": box_figure(table), "ablation_maps": map_figure(table)}


ABLATION = Study(
    name="ablation",
    title="What map, density and weights do",
    options=AblationOptions,
    size=frozenset({"batches"}),
    cell=AblationCell,
    summary=AblationTable,
    keys=keys,
    site=site,
    prepare=prepare,
    compute=compute,
    summarise=summarise,
    page=ablation_page,
    figures=figures,
)
