"""Options of a localisation that work off line only."""

from l2m_gtsam.errors import ConfigError
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions, StepAxes


def check_options(options: SlamOptions, *, has_map: bool, one_field: bool) -> None:
    """Refuse what works off line only.

    Parameters
    ----------
    options
        As of ``OnlineSlam``.
    has_map
        Whether there is a map.
    one_field
        Whether there is a single sensor and nothing else that knows its places.

    Raises
    ------
    ConfigError
        Odometry knows its steps along fixed axes, in a map or with several sensors; or, without a
        map, the start is to be searched for, or the calibration of a single sensor to be refined.
    """
    if options.drift.axes is StepAxes.FIXED and not one_field:
        raise ConfigError(
            "`slam.drift.axes: fixed` works off line, and on line with one sensor and no map; give "
            "`vehicle`"
        )
    if has_map:
        return
    if options.start.anywhere:
        raise ConfigError("`slam.start.anywhere` searches a map for the start: give one with --map")
    if options.calibration is CalibrationUse.REFINED and one_field:
        raise ConfigError(
            "`slam.calibration: refined` of one sensor without a map works off line; on line give "
            "`fixed`"
        )
