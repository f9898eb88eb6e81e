"""What speaks against the outcome of a validation, and what is worth knowing beside it."""

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import SourceFile, same_content
from l2m_gtsam.maps.field_map import Summarised
from l2m_gtsam.records.calibration import CalibrationResult, Uncertainty
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.validation.innovation import knows_its_errors

SAME_MAP = (
    "This is the map that it was calibrated with: errors of the map that the calibration took over "
    "do not show. A map of another survey would show them."
)
NO_TRACES = (
    "The calibration's file is older than poses in it: only the hash of its drive was compared, "
    "and a copy of that drive would not be recognised."
)
UNJUDGED = "The calibration was not judged: its file holds no verdict."
FAILED = "The calibration itself was judged FAIL when it was computed: calibration.yaml says why."
NOT_CORRELATED = (
    "This kind of map does not know how its errors are correlated; they count as each reading's "
    "own, and chance may be reported as a change."
)
LOWER_BOUNDS = (
    "The calibration's sigmas are lower bounds (`uncertainty: independent`): small changes may be "
    "named that are none."
)


def doubts_and_notes(
    field_map: QueryableMap, calibration: CalibrationResult, map_source: SourceFile | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what speaks against the outcome, and what is worth knowing."""
    of_map = field_map.summary.doubts if isinstance(field_map, Summarised) else ()
    doubts, notes = [f"Of the map: {each}." for each in of_map], list[str]()
    if same_content(calibration.map, map_source):
        notes.append(SAME_MAP)
    if not calibration.traces:
        notes.append(NO_TRACES)
    judged = calibration.judgement
    if judged is None:
        notes.append(UNJUDGED)
    elif judged.level is Level.FAIL:
        doubts.append(FAILED)
    if not knows_its_errors(field_map):
        notes.append(NOT_CORRELATED)
    if calibration.uncertainty is Uncertainty.INDEPENDENT:
        notes.append(LOWER_BOUNDS)
    return tuple(doubts), tuple(notes)
