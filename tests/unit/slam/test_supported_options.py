"""Options that work off line only."""

import pytest

from l2m_gtsam.errors import ConfigError
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import SlamOptions
from tests.drives.slam import calibrated
from tests.worlds.exact import random_sensors


@pytest.mark.parametrize(
    ("options", "sensors", "text"),
    [
        ({"start": {"anywhere": True}}, 2, "give one with --map"),
        ({"calibration": "refined"}, 1, "works off line"),
        ({"drift": {"axes": "fixed"}}, 2, "works off line"),
    ],
)
def test_without_a_map_they_are_refused(
    options: dict[str, object], sensors: int, text: str
) -> None:
    with pytest.raises(ConfigError, match=text):
        OnlineSlam(calibrated(random_sensors(2, sensors)), SlamOptions.model_validate(options))


def test_several_sensors_are_refined() -> None:
    OnlineSlam(
        calibrated(random_sensors(2, 2)), SlamOptions.model_validate({"calibration": "refined"})
    )
