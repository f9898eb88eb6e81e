"""Maps and calibrations of one place that many tests ask for: computed once in a run of the tests.

Commands, bags, files and pages are those of each test; only equal numbers from equal numbers are
not computed again.
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TypeVar, cast

import pytest

from l2m_gtsam.api import calls
from l2m_gtsam.batch import drives, maps
from l2m_gtsam.calibration.calibrate import Calibrated, calibrated
from l2m_gtsam.calibration.changed_places import ChangesOptions
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, KnownSensor, Recording, SourceFile
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.maps.field_map import FieldMap, Summarised
from l2m_gtsam.progress import Progress, silent
from l2m_gtsam.upkeep.surveys import map_surveys
from tests.support.kept import kept

Found = TypeVar("Found")


@contextmanager
def computed_once() -> Iterator[None]:
    """Compute a map of a survey, and a calibration of a drive on a map, once for all workers."""
    here: dict[str, object] = {}

    def once(key: object, compute: Callable[[], Found]) -> Found:
        name = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        if name not in here:  # with the tiles that it has opened
            here[name] = kept(name, compute)
        return cast("Found", here[name])

    def mapped(
        recordings: Sequence[Recording],
        suite: Mapping[str, KnownSensor] | None,
        options: MappingOptions,
        changes: ChangesOptions,
        cloud: FloatArray | None = None,
    ) -> FieldMap:
        read = [readings_of(each) for each in recordings]
        points = None if cloud is None else hashlib.sha256(cloud.tobytes()).hexdigest()
        key = ("map", read, suite, options, changes, points)
        return once(key, lambda: map_surveys(recordings, suite, options, changes, cloud))

    def solved(
        recording: Recording,
        field_map: QueryableMap,
        options: CalibrationOptions,
        map_source: SourceFile | None = None,
        progress: Progress = silent,
    ) -> Calibrated:
        assert isinstance(field_map, Summarised)
        key = ("calibration", readings_of(recording), field_map.summary, options)
        found = once(key, lambda: calibrated(recording, field_map, options, map_source, progress))
        return replace(found, result=replace(found.result, bag=recording.source, map=map_source))

    with pytest.MonkeyPatch.context() as patch:
        for module in (calls, maps):
            patch.setattr(module, "map_surveys", mapped)
        for module in (calls, drives):
            patch.setattr(module, "calibrated", solved)
        yield


def readings_of(recording: Recording) -> str:
    """Return a sum over what was read and where, whoever read it from a bag."""
    poses, digest = recording.trajectory, hashlib.sha256()
    arrays = [poses.stamp_ns, poses.R, poses.p]
    arrays += [each for one in recording.series for each in (one.stamp_ns, one.field)]
    for each in arrays:
        digest.update(each.tobytes())
    names = [each.sensor for each in recording.series]
    return f"{names} {poses.covariance is None} {digest.hexdigest()}"
