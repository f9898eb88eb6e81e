"""What a localisation on line cannot be made of is refused in one line."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from l2m_gtsam.errors import InputError
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import SlamOptions
from tests.drives.slam import calibrated
from tests.worlds.exact import DipoleWorld, dipole_world, random_sensors

KNOWN = calibrated(random_sensors(1, 2))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"calibration": SimpleNamespace(result=KNOWN)}, "calibration: one SimpleNamespace was"),
        ({"calibration": "calibration.yaml"}, "calibration: 'calibration.yaml' was given"),
        ({"options": {}}, "options: one dict was given; needed is SlamOptions"),
        ({"options": None}, "options: None was given; needed is SlamOptions"),
        ({"field_map": Path("map.npz")}, "field_map: one PosixPath was given; needed is a map"),
        ({"field_map": SimpleNamespace(field_and_gradient=len)}, "field_map: one SimpleNamespace"),
        ({"field_map": DipoleWorld}, "field_map: one type was given"),
    ],
)
def test_what_is_something_else_is_named_with_what_is_wanted(
    given: dict[str, Any], message: str
) -> None:
    usable: dict[str, Any] = {"calibration": KNOWN, "options": SlamOptions()}
    with pytest.raises(InputError) as found:
        OnlineSlam(**usable | {"field_map": dipole_world(1)} | given)
    assert str(found.value).startswith(message)
    assert len(str(found.value).splitlines()) == 1


def test_a_judged_calibration_is_told_where_its_result_is() -> None:
    with pytest.raises(InputError, match=r"the `result` of what `l2m_gtsam.calibrate` returns"):
        OnlineSlam(SimpleNamespace(result=KNOWN), SlamOptions())  # type: ignore[arg-type]  # fault
