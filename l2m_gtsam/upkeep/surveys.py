"""Surveys -> the map of a place as the last of them found it. Pure: no files."""

from collections.abc import Mapping, Sequence

from l2m_gtsam.calibration.changed_places import ChangesOptions
from l2m_gtsam.data import FloatArray, KnownSensor, Recording
from l2m_gtsam.errors import L2MError
from l2m_gtsam.mapping.map_building import map_of
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.mapping.steady_survey import steady_survey
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.upkeep.agreement import is_kept_well
from l2m_gtsam.upkeep.survey_change import parted
from l2m_gtsam.upkeep.survey_drives import SurveyDrives

# Of sensors whose errors are stated some stays, within sigmas: with 2 mm, 0.2 % and 0.1 uT halves
# along x and along y differed by 1.04; drives in frames 2 cm apart by 2.6 to 2.9.
BESIDE_STATED = 2.0


@one_blas_thread()
def map_surveys(
    recordings: Sequence[Recording],
    suite: Mapping[str, KnownSensor] | None,
    options: MappingOptions,
    changes: ChangesOptions,
    cloud: FloatArray | None = None,
) -> FieldMap:
    """Build a map from one or several drives of a suite, as the last of them found the place.

    Parameters
    ----------
    recordings, suite, options, cloud
        As of ``mapping.map_building.map_recordings``.
    changes
        How steel is looked for that came or went between drives, or during a single one: where
        their readings of one place differ.

    Raises
    ------
    MapError, SyncError
        As in ``map_recordings``.
    """
    steady = steady_survey(recordings, suite, options.suite)
    if options.model.kind != HarmonicMap.kind:
        return map_of(steady, suite, options, cloud)
    drives = SurveyDrives.of(steady, suite, options, changes)
    field_map = drives.mapped(len(recordings), cloud)
    apart = drives.disagreement(field_map)
    if apart < 1:
        return field_map
    try:
        kept = with_changes(drives, cloud)
    except L2MError:  # a part is too little by itself to tell what changed
        kept = None
    if kept is not None:
        return kept
    # Errors of poses, and of sensors of which nothing was stated, are in the sigmas if found.
    off = field_map.learnt.suite is not None and not drives.stated
    counted = field_map.learnt.poses is not None or off
    if counted or apart < (BESIDE_STATED if drives.stated else 1):
        return field_map
    return field_map.doubted((differing(len(recordings)),))


def with_changes(drives: SurveyDrives, cloud: FloatArray | None) -> HarmonicMap | None:
    """Return a map with what changed between drives, or during a single one; None if nothing."""
    several = drives if len(drives.steady.recordings) > 1 else parted(drives, cloud)
    first = None if several is None else several.unlike(cloud)
    if several is None or first is None:
        return None
    kept = several.kept_up(first, cloud)
    return kept if is_kept_well(kept) else kept.doubted((STILL_DIFFERING,))


STILL_DIFFERING = (
    "beside the steel that came or went during the survey, readings of one place before and after "
    "it still differ by more than noise: sigmas near it are too small; survey again while nothing "
    "moves"
)


def differing(drives: int) -> str:
    """Return that readings of one place differ, and no steel explains it."""
    parts = "the drives" if drives > 1 else "both halves"
    return (
        f"readings of one place differ between {parts} of the survey by more than noise: poses, "
        "clocks or sensors were others, or something small moved, and sigmas are too small; "
        "localise all on one point cloud, and survey while nothing moves"
    )
