r"""When a place changed during a drive of its survey.

Of two halves one at least is of one place. What the other shows beside a map of it is steel that
was there for all of that half, or for a part. With e what a reading lacks of the map, b the field
of that steel and v the variance of the map and the noise,

.. math::
    l_n = \frac{1}{2} \sum_i \frac{e_{ni}^2 - (e_{ni} - b_{ni})^2}{v_{ni}}

is by how much a reading is more likely with it. Where the sum of all after a reading is largest, or
of all before it if the later half is the one that was mapped, the place changed.
"""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, Recording
from l2m_gtsam.errors import L2MError
from l2m_gtsam.mapping.map_building import survey_readings
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.renewal import shape_of
from l2m_gtsam.recording.splitting import split_at
from l2m_gtsam.upkeep.kept_map import SeenSources
from l2m_gtsam.upkeep.survey_drives import LEAST_GAIN, SurveyDrives, middle


@dataclass(frozen=True)
class MappedHalf:
    """A map of one half of a drive, and what the other half shows beside it."""

    field_map: HarmonicMap
    other: Recording
    seen: SeenSources


def parted(drives: SurveyDrives, cloud: FloatArray | None) -> SurveyDrives | None:
    """Return a drive as two, before and after the place changed; None where it did not.

    Parameters
    ----------
    drives
        One drive.
    cloud
        Structure in the map frame in metres, shape (M, 3), if there is any.
    """
    (recording,) = drives.steady.recordings
    both = split_at(recording, middle(recording))
    mapped = [mapped_half(drives, *pair, cloud) for pair in (both, both[::-1])]
    gains = [0.0 if each is None else each.seen.gain for each in mapped]
    later = int(np.argmax(gains))
    found = mapped[later]
    if found is None or gains[later] < LEAST_GAIN:
        return None
    stamp_ns = moment_of(drives, found, before=bool(later))
    return drives.instead(split_at(recording, stamp_ns))


def mapped_half(
    drives: SurveyDrives, half: Recording, other: Recording, cloud: FloatArray | None
) -> MappedHalf | None:
    """Return a half that is mapped; None where it cannot be, or no steel changed."""
    try:
        field_map = drives.instead((half,)).mapped(1, cloud)
        seen = drives.vehicle.shows(other, field_map)
    except L2MError:  # too little by itself to tell
        return None
    return None if seen.of_vehicle or not seen.sources else MappedHalf(field_map, other, seen)


def moment_of(drives: SurveyDrives, found: MappedHalf, *, before: bool) -> int:
    """Return the stamp from which on the place is another, in nanoseconds."""
    vehicle = drives.vehicle
    read = survey_readings(found.other, vehicle.suite, vehicle.options.sync)
    known = found.field_map.query(read.points)
    lacking = read.field - known.field
    shapes = [shape_of(each) for each in found.seen.sources]
    field = np.sum([each.field_and_gradient(read.points)[0] for each in shapes], axis=0)
    variance = known.variance + found.field_map.learnt.hyperparameters.noise**2
    likelier = 0.5 * np.sum((lacking**2 - (lacking - field) ** 2) / variance, axis=1)
    stamps, gains = read.stamp_ns[known.inside], likelier[known.inside]
    order = np.argsort(stamps, kind="stable")
    sums = np.append(0.0, np.cumsum(gains[order]))
    number = int(np.argmax(sums) if before else np.argmin(sums))
    return int(stamps[order[min(number, len(stamps) - 1)]])
