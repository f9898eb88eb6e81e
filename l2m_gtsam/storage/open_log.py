"""Open a log of any kind: bags, tables in CSV, ULogs of PX4."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.bag_options import ColumnOptions
from l2m_gtsam.storage.bounded import require_regular
from l2m_gtsam.storage.csv_log import read_csv_log
from l2m_gtsam.storage.log import Log
from l2m_gtsam.storage.open_bag import ACCEPTED, TABLES, open_bag
from l2m_gtsam.storage.ulog import read_ulog


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
        raise BagError(f"{path}: what it is does not follow from its name; call a table .csv")
    if not is_table(path):
        with open_bag(path) as bag:
            yield bag
        return
    require_regular(path, BagError, f"no such file; accepted: {ACCEPTED}")
    is_ulog = path.suffix.lower() == ".ulg"
    yield read_ulog(path) if is_ulog else read_csv_log(path, columns or ColumnOptions())
