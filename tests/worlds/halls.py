"""A hall with one rack that is simulated, mapped and calibrated in seconds: the tutorial's."""

from typing import Any

SMALL_HALL: dict[str, Any] = {
    "floor_plan": {
        "length": 11.0,
        "width": 6.4,
        "rack_rows": 1,
        "rack_depth": 1.4,
        "blocks": 1,
        "cross_aisle": 3.4,
    },
    "suite": {"lateral": [-0.3, 0.3], "heights": [-0.5, 0.0]},
    "array": {"count": 2},
    "mapping_sampling": {"field_rate": 5.0},
    "calibration_sampling": {"field_rate": 4.0},
    "calibration_route": {"turns": 1},
}
