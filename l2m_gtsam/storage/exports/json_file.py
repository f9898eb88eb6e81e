"""Everything that is known of the sensors, as JSON."""

import json
import math
from typing import Any

from l2m_gtsam.storage.calibration_file import bag_entries, sensor_entry, source_entry
from l2m_gtsam.storage.calibration_legend import MODEL, UNCERTAINTY
from l2m_gtsam.storage.exports.export import Export

UNKNOWN = "null: not determined by the drive and the map (an infinite variance), or not known"


def json_text(export: Export) -> str:
    """Return the sensors with formulas, units, frames, covariances and where they come from.

    Numbers that are not finite, which JSON does not have, are null.
    """
    result = export.result
    content = {
        "format": "l2m-export",
        "version": 1,
        "model": {"uncertainty": UNCERTAINTY[result.uncertainty], **MODEL, "infinite": UNKNOWN},
        "lidar_frame": export.lidar_frame,
        **bag_entries(result),
        "map": source_entry(result.map),
        "versions": result.versions,
        "doubts": list(result.doubts),
        "left_out": dict(export.left_out),
        "sensors": {
            each.calibration.sensor: {"frame": each.frame, **sensor_entry(each.calibration)}
            for each in export.sensors
        },
    }
    return json.dumps(_finite(content), indent=2, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    """Return plain values with None for numbers that are not finite."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
