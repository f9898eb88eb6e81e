"""Columns of times are no axes of a magnetometer, whatever they are called."""

import pytest

from l2m_gtsam.storage.bag_options import ColumnOptions
from l2m_gtsam.storage.csv_columns import column_roles

MAG = ["mag_x", "mag_y", "mag_z"]


@pytest.mark.parametrize(
    ("more", "options"),
    [
        (["mag_stamp_x", "mag_stamp_y", "mag_stamp_z", "t"], ColumnOptions()),
        (["mag_timestamp[0]", "mag_timestamp[1]", "mag_timestamp[2]", "t"], ColumnOptions()),
        (["mag time x", "mag time y", "mag time z", "time"], ColumnOptions()),
        (["magclock_x", "magclock_y", "magclock_z"], ColumnOptions(stamp="magclock_x")),
    ],
)
def test_columns_of_times_are_no_magnetometer(more: list[str], options: ColumnOptions) -> None:
    roles = column_roles([*MAG, *more], options, "log")
    assert {name: each.columns for name, each in roles.fields.items()} == {"mag": (0, 1, 2)}


def test_a_column_of_times_that_is_given_as_an_axis_is_refused() -> None:
    options = ColumnOptions(stamp="t", fields={"front": ("t", "mag_y", "mag_z")})
    with pytest.raises(ValueError, match="'t' has the times, it is no axis of the magnetometer fr"):
        column_roles([*MAG, "t"], options, "log")
    turned = ColumnOptions(stamp="t", orientation=("mag_x", "mag_y", "mag_z", "t"))
    with pytest.raises(ValueError, match="'t' has the times, it is no axis of the orientation"):
        column_roles([*MAG, "t"], turned, "log")
