"""The honesty study as cells, page and figures: ``l2m study honesty``."""

from collections.abc import Mapping

from l2m_gtsam.studies.honesty.cells import Cell, cell_of
from l2m_gtsam.studies.honesty.conditions import Condition, HonestyOptions
from l2m_gtsam.studies.honesty.page import honesty_page
from l2m_gtsam.studies.honesty.pictures import honesty_figures
from l2m_gtsam.studies.honesty.place import Place, surveyed_hall
from l2m_gtsam.studies.honesty.summary import HonestySummary, honesty_summary, settings
from l2m_gtsam.studies.study import Study


def keys(options: HonestyOptions) -> tuple[str, ...]:
    """Return a cell for each noise, survey and condition, those of one survey together."""
    wanted = settings(options)
    return tuple(
        f"{noise!r}-uT-survey-{number:03d}-{condition}"
        for noise in sorted({noise for _, noise in wanted})
        for number in range(options.surveys)
        for condition in Condition
        if (condition, noise) in wanted
    )


def site(options: HonestyOptions, key: str) -> str:
    """Return noise and survey: both conditions have the same map."""
    return key.rpartition("-")[0]


def prepare(options: HonestyOptions, name: str) -> Place:
    """Return a hall with its map."""
    noise, _, number = name.partition("-uT-survey-")
    return surveyed_hall(options, float(noise), int(number))


def compute(options: HonestyOptions, key: str, place: Place) -> Cell:
    """Calibrate on all drives through a hall."""
    return cell_of(options, place, Condition(key.rpartition("-")[2]))


def summarise(options: HonestyOptions, cells: Mapping[str, Cell]) -> HonestySummary:
    """Judge."""
    return honesty_summary(options, list(cells.values()))


HONESTY = Study(
    name="honesty",
    title="Are the stated errors true?",
    options=HonestyOptions,
    size=frozenset({"surveys", "noises", "troubled_noises"}),
    cell=Cell,
    summary=HonestySummary,
    keys=keys,
    site=site,
    prepare=prepare,
    compute=compute,
    summarise=summarise,
    page=honesty_page,
    figures=honesty_figures,
)
