"""What a localisation on line is made of, checked: one line says what came, and what is wanted."""

from l2m_gtsam.errors import InputError
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.text import shown, shown_value

CALIBRATION = "a CalibrationResult: the `result` of what `l2m_gtsam.calibrate` returns"
OPTIONS = "SlamOptions: `SlamOptions()`, or `SlamOptions.model_validate({...})` of a mapping"
MAP = "a map, made by `l2m_gtsam.build_map` or `l2m_gtsam.load_map`, or None"
ASKED = ("query", "field_and_gradient")


def refuse_unusable(calibration: object, options: object, field_map: object) -> None:
    """Refuse what is no calibration, options or map.

    Raises
    ------
    InputError
        For the first of them, with what is wanted.
    """
    if not isinstance(calibration, CalibrationResult):
        raise _refused("calibration", calibration, CALIBRATION)
    if not isinstance(options, SlamOptions):
        raise _refused("options", options, OPTIONS)
    if field_map is not None and not _is_map(field_map):
        raise _refused("field_map", field_map, MAP)


def _is_map(value: object) -> bool:
    is_class = isinstance(value, type)
    return not is_class and all(callable(getattr(value, name, None)) for name in ASKED)


def _refused(name: str, value: object, wanted: str) -> InputError:
    plain = value is None or isinstance(value, str | bool | int | float)
    came = shown_value(value) if plain else f"one {type(value).__name__}"
    return InputError(f"{name}: {shown(came)} was given; needed is {wanted}")
