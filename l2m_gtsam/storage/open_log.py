"""Open a log of any kind: bags, tables in CSV, ULogs of PX4."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.bag_options import ColumnOptions
from l2m_gtsam.storage.bounded import require_regular
from l2m_gtsam.storage.csv_log import read_csv_log
from l2m_gtsam.storage.log import ACCEPTED, TABLES, TableLog
from l2m_gtsam.storage.open_bag import Bag, open_bag
from l2m_gtsam.storage.ulog import read_ulog

Log = Bag | TableLog
READERS: dict[str, Callable[[Path, ColumnOptions], Log]] = {
    ".csv": read_csv_log,
    ".ulg": lambda path, _: read_ulog(path),
}
"""Of each of ``TABLES``: the whole file as a log."""


def is_table(path: Path) -> bool:
    """Return whether a log is no bag, by its name: it has no point clouds and cannot be copied."""
    return path.suffix.lower() in TABLES


@contextmanager
def open_log(path: Path, columns: ColumnOptions | None = None) -> Iterator[Log]:
    """Open a log of any kind for reading.

    Parameters
    ----------
    path
        A bag, a table in CSV or a ULog of PX4.
    columns
        Which columns of a CSV file are what, where their names do not say it.

    Raises
    ------
    BagError
        No such file, of no kind that is read, damaged, or without messages.
    """
    if path.suffix.lower() in (".txt", ".dat", ".log", ".tsv") and path.is_file():
        raise BagError(
            f"{path}: its name does not state its format; call a table .csv; accepted: {ACCEPTED}"
        )
    if not is_table(path):
        with open_bag(path) as bag:
            yield bag
        return
    require_regular(path, BagError, f"no such file; accepted: {ACCEPTED}")
    yield READERS[path.suffix.lower()](path, columns or ColumnOptions())
