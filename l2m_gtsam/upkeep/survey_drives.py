"""Drives of a survey, between which the place may have changed.

Steel that stands in some of the drives alone is neither in the place nor out of it: a map of all
readings alike is wrong near it, and blames sensors and poses. Each drive is therefore asked what it
shows beside a map of those before it. Where that is steel, the map is kept up from then on: it is
of the place as the last drive found it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from l2m_gtsam.calibration.changed_places import ChangesOptions
from l2m_gtsam.data import FloatArray, KnownSensor, Recording, joined_rows
from l2m_gtsam.errors import L2MError
from l2m_gtsam.mapping.map_building import map_of, survey_readings
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.mapping.steady_survey import SteadySurvey
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.upkeep.agreement import disagreement
from l2m_gtsam.upkeep.kept_map import MappingVehicle, SeenSources, drive_dates

# Twice a logarithm of likelihood. At its edges a map of coarse waves misses 0.2 A m^2 of steel that
# is not there, by 50 of it; a fork lift beside the path has 10^5.
LEAST_GAIN = 100.0


@dataclass(frozen=True)
class SurveyDrives:
    """Drives of a survey in the order of their time, and the vehicle that is assumed."""

    steady: SteadySurvey
    vehicle: MappingVehicle

    @classmethod
    def of(
        cls,
        steady: SteadySurvey,
        suite: Mapping[str, KnownSensor] | None,
        options: MappingOptions,
        changes: ChangesOptions,
    ) -> "SurveyDrives":
        """Return drives in order; sensors of which nothing is known are ideal."""
        recordings = sorted(steady.recordings, key=lambda each: int(each.trajectory.stamp_ns[0]))
        names = {series.sensor for each in recordings for series in each.series}
        known = {name: KnownSensor.ideal(name) for name in names} if suite is None else suite
        vehicle = MappingVehicle(known, options, changes)
        return cls(replace(steady, recordings=recordings), vehicle)

    @property
    def stated(self) -> bool:
        """Whether it is stated how well any sensor is known."""
        return any(each.covariance is not None for each in self.vehicle.suite.values())

    def instead(self, recordings: Sequence[Recording]) -> "SurveyDrives":
        """Return the same with other drives, in order of time."""
        return replace(self, steady=replace(self.steady, recordings=recordings))

    def mapped(self, count: int, cloud: FloatArray | None) -> HarmonicMap:
        """Return a map of the first drives, so many of them."""
        first = replace(self.steady, recordings=self.steady.recordings[:count])
        field_map = map_of(first, self.vehicle.suite, self.vehicle.options, cloud)
        if not isinstance(field_map, HarmonicMap):
            raise TypeError(f"maps of kind {field_map.kind} are not kept up")
        return field_map

    def disagreement(self, field_map: HarmonicMap) -> float:
        """Return by how much the drives differ, or both halves of one; 1 is beyond chance."""
        recordings, parts, number = self.steady.recordings, [], []
        for k, each in enumerate(recordings):
            read = survey_readings(each, self.vehicle.suite, self.vehicle.options.sync)
            late = (read.stamp_ns >= middle(each)).astype(np.int64)
            number.append(np.full_like(late, k) if len(recordings) > 1 else late)
            known = read.suite.as_found_by(field_map.learnt.suite)
            ones = np.ones(len(read.points))
            parts.append(TrainingSet(read.points, known.corrected(read.field), ones))
        return disagreement(field_map, joined_rows(parts), np.concatenate(number))

    def unlike(self, cloud: FloatArray | None) -> "Unlike | None":
        """Return the first drive that differs from those before it, if any does."""
        recordings = self.steady.recordings
        try:
            field_map = self.mapped(1, cloud)
        except L2MError:  # too little by itself to tell
            return None
        for number, recording in enumerate(recordings[1:], start=1):
            seen = self.vehicle.shows(recording, field_map)
            if max(seen.gain, seen.vehicle) > LEAST_GAIN and (seen.sources or seen.of_vehicle):
                return Unlike(number, seen, field_map)
            options = self.vehicle.options
            given = recording, self.vehicle.suite, options.sync, options.pose_noise
            read = survey_readings(*given)
            field_map = field_map.updated(read.points, read.field, read.suite, read.poses)
        return None

    def kept_up(self, first: "Unlike", cloud: FloatArray | None) -> HarmonicMap:
        """Return a map of the drives before one that differs, after that one and all later."""
        recordings, number = self.steady.recordings, first.number
        seen: SeenSources | None = first.seen
        survey = drive_dates(*recordings[:number])
        # A map of one drive is that already; one that was updated has the prior of the first.
        field_map = first.field_map if number == 1 else self.mapped(number, cloud)
        for each in recordings[number:]:
            seen = seen or self.vehicle.shows(each, field_map)
            if seen.of_vehicle:
                return self.doubted(each, cloud)
            given = each, drive_dates(each), seen, survey
            field_map, seen = self.vehicle.kept(field_map, *given), None
        return field_map

    def doubted(self, recording: Recording, cloud: FloatArray | None) -> HarmonicMap:
        """Return a map of all drives, one of which sensors read otherwise."""
        field_map = self.mapped(len(self.steady.recordings), cloud)
        name = Path(recording.source.path).name
        return field_map.doubted(
            (
                (
                    f"the sensors read otherwise in {name} than in the drives before it, wherever "
                    "they are: something of the vehicle changed. Calibrate them anew (`l2m map "
                    "suite`), or survey by drives of one and the same vehicle"
                ),
            )
        )


def middle(recording: Recording) -> int:
    """Return the time in the middle of a drive, in nanoseconds."""
    first, last = recording.trajectory.stamp_ns[[0, -1]].tolist()
    return (int(first) + int(last)) // 2


@dataclass(frozen=True)
class Unlike:
    """A drive that differs from those before it.

    Attributes
    ----------
    number
        Of the drive.
    seen
        What it shows beside them.
    field_map
        That they make.
    """

    number: int
    seen: SeenSources
    field_map: HarmonicMap
