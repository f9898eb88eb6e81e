"""SQLite keeps in a cell whatever is written to it: numbers with a fraction, text, nothing."""

import sqlite3
from pathlib import Path

import pytest

from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.inspect import inspect_bag
from tests.drives.bags import Entry, ros, write


@pytest.mark.parametrize("column", ["name", "type"])
def test_topics_that_are_no_text(tmp_path: Path, column: str) -> None:
    dialect = ros("sqlite3")
    message = dialect.magnetic(1, (1e-5, 2e-5, 4e-5))
    bag = write(tmp_path, "sqlite3", [Entry("/mag", "sensor_msgs/MagneticField", 1, message)])
    file = next(bag.glob("*.db3"))
    with sqlite3.connect(file) as base:
        base.execute(f"UPDATE topics SET {column} = ?", (b"/mag",))  # noqa: S608
    base.close()
    with pytest.raises(BagError, match="not a readable bag"):
        inspect_bag(file, BagOptions())


@pytest.mark.parametrize("value", [1.5, None, "x", b"\0", 2**62, -(2**62)])
@pytest.mark.parametrize("column", ["timestamp", "data"])
def test_other_cells_are_one_line(tmp_path: Path, column: str, value: object) -> None:
    dialect = ros("sqlite3")
    entries = [
        Entry("/mag", "sensor_msgs/MagneticField", k, dialect.magnetic(k, (1e-5, 2e-5, 4e-5)))
        for k in range(10**9, 10**9 + 5)
    ]
    file = next(write(tmp_path, "sqlite3", entries).glob("*.db3"))
    with sqlite3.connect(file) as base:
        base.execute("CREATE TABLE others AS SELECT * FROM messages")  # without constraints
        base.execute("DROP TABLE messages")
        base.execute("ALTER TABLE others RENAME TO messages")
        base.execute(f"UPDATE messages SET {column} = ? WHERE id = 3", (value,))  # noqa: S608
    base.close()
    if column == "timestamp" and isinstance(value, int):  # a time, however early or late
        assert inspect_bag(file, BagOptions()).topics
        return
    with pytest.raises(BagError, match=r"damaged|not a readable bag"):
        inspect_bag(file, BagOptions())
