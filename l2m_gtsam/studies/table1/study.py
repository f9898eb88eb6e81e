"""Table I as cells, page and figure: ``l2m study table1``."""

from itertools import product

from l2m_gtsam.studies.study import Study
from l2m_gtsam.studies.table1 import report
from l2m_gtsam.studies.table1.cells import Place, Table1Cell, Table1Options, compute, prepare
from l2m_gtsam.studies.table1.summary import Table1Summary, summarise


def keys(options: Table1Options) -> tuple[str, ...]:
    """Return a cell for each drive: noise level, path, number."""
    sizes = (len(options.noises), len(options.paths), options.distortions)
    return tuple("-".join(f"{i:02d}" for i in each) for each in product(*map(range, sizes)))


def site(options: Table1Options, key: str) -> str:
    """Return the only place."""
    return "warehouse"


def place(options: Table1Options, name: str) -> Place:
    """Return the place."""
    return prepare(options)


def cell(options: Table1Options, key: str, there: Place) -> Table1Cell:
    """Calibrate the sensor of one drive."""
    level, row, number = map(int, key.split("-"))
    return compute(options, there, level, row, number)


TABLE1 = Study(
    name="table1",
    title="The paper's Table I",
    options=Table1Options,
    size=frozenset({"distortions"}),
    cell=Table1Cell,
    summary=Table1Summary,
    keys=keys,
    site=site,
    prepare=place,
    compute=cell,
    summarise=summarise,
    page=report.page,
    figures=report.figures,
)
