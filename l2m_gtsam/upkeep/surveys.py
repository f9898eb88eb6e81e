"""Surveys -> the map of a place as the last of them found it. Pure: no files."""

from collections.abc import Mapping, Sequence

from l2m_gtsam.calibration.changed_places import ChangesOptions
from l2m_gtsam.data import FloatArray, KnownSensor, Recording
from l2m_gtsam.mapping.map_building import map_of
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.mapping.steady_survey import steady_survey
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.upkeep.survey_change import parted
from l2m_gtsam.upkeep.survey_drives import SurveyDrives


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
        How steel is looked for that came or went between drives, or during a single one that its
        map does not explain.

    Raises
    ------
    MapError, SyncError
        As in ``map_recordings``.
    """
    steady = steady_survey(recordings, suite, options.suite)
    if options.model.kind != HarmonicMap.kind:
        return map_of(steady, suite, options, cloud)
    drives = SurveyDrives.of(steady, suite, options, changes)
    if len(recordings) == 1:
        field_map = drives.mapped(1, cloud)
        if not (isinstance(field_map, HarmonicMap) and is_unexplained(field_map)):
            return field_map
        both = parted(drives, cloud)
        first = None if both is None else both.unlike(cloud)
        return field_map if both is None or first is None else both.kept_up(first, cloud)
    first = drives.unlike(cloud)
    return drives.mapped(len(recordings), cloud) if first is None else drives.kept_up(first, cloud)


def is_unexplained(field_map: HarmonicMap) -> bool:
    """Return whether a map does not explain its readings, or only by sensors that are off."""
    learnt = field_map.learnt
    off = learnt.suite is not None and not learnt.suite.stated
    return off or bool(learnt.origin.explanation.reasons)
