"""Drives of a survey without what sensors do along them: spikes, jumps of H, drifts of clocks."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from l2m_gtsam.data import FloatArray, KnownSensor, Recording
from l2m_gtsam.errors import L2MError
from l2m_gtsam.mapping.clock_drifts import clock_drifts, since_middle, steadied
from l2m_gtsam.mapping.offset_jumps import jumps_of, refined
from l2m_gtsam.mapping.options import SuiteCalibrationOptions
from l2m_gtsam.mapping.seen_windows import SeenWindows
from l2m_gtsam.mapping.suite_drive import SuiteDrive, suite_drive
from l2m_gtsam.mapping.survey_jump import SurveyJump, with_more, without_jumps
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.recording.joining import drive_at, own_ns
from l2m_gtsam.recording.spikes import without_spikes
from l2m_gtsam.records.error_budget import MOST_JUMPS

FEW = {"windows": 4, "readings": 600, "modes": 200}  # enough to judge sensors and clocks by
ROUNDS = 8  # of jumps that are looked for beside those that were taken off
NOTED = 0.002  # share of a sensor's readings: fewer spikes are no reason to doubt it


@dataclass(frozen=True)
class SteadySurvey:
    """Drives of a survey that are corrected, and a sentence for all that was wrong with them."""

    recordings: Sequence[Recording]
    doubts: tuple[str, ...] = ()

    def doubted_before(self, doubts: tuple[str, ...]) -> "SteadySurvey":
        """Return the same after other sentences."""
        return SteadySurvey(self.recordings, (*doubts, *self.doubts))


@one_blas_thread()
def steady_survey(
    recordings: Sequence[Recording],
    known: Mapping[str, KnownSensor] | None,
    options: SuiteCalibrationOptions,
) -> SteadySurvey:
    """Return drives of calibrated sensors as if these had been steady.

    Parameters
    ----------
    recordings
        Drives with poses in one map frame.
    known, options
        As in ``suite_doubts``.
    """
    sound = sound_survey(recordings, options)
    few = options.model_copy(update=FEW)
    try:
        drive = suite_drive(sound.recordings, known, few)
        steady = with_steady_sensors(sound.recordings, drive, drive.assumed, few)
    except L2MError:  # a survey too small to judge its sensors by
        return sound
    return steady.doubted_before(sound.doubts)


def sound_survey(recordings: Sequence[Recording], options: SuiteCalibrationOptions) -> SteadySurvey:
    """Return drives without single spikes."""
    found = [without_spikes(each, options.sync.max_pose_gap_s) for each in recordings]
    doubts = tuple(
        f"{series.sensor}: {share:.1%} of its readings in {Path(recording.source.path).name} are "
        "spikes, unlike those before and after. They do not count. Look for a loose plug or "
        "electric pulses"
        for recording, (_, shares) in zip(recordings, found, strict=True)
        for series, share in zip(recording.series, shares, strict=True)
        if share > NOTED
    )
    return SteadySurvey([each for each, _ in found], doubts)


def with_steady_sensors(
    recordings: Sequence[Recording],
    drive: SuiteDrive,
    sensors: FloatArray,
    options: SuiteCalibrationOptions,
) -> SteadySurvey:
    """Return recordings, that a drive joins, without jumps of H and drifts of clocks.

    ``sensors`` are their parameters, shape (S, 16). H is that of the part of the survey that agrees
    with them.
    """
    found: tuple[SurveyJump, ...] = ()
    moved = drive.recording.moved_ns or (0,)
    by = {id(part): each for part, each in zip(drive.recording.parts, moved, strict=True)}
    steady, now = recordings, drive
    for number in range(ROUNDS + 1):
        readings = now.at(sensors[:, -1])
        seen = SeenWindows.of(readings, sensors, options)
        more = jumps_of(readings, sensors, seen, options)
        if not more or number == ROUNDS:
            break
        if own := wandering(with_more(found, more)):  # that is no jump, as in a drive
            found = tuple(each for each in found if each.sensor not in own)
            break
        found = with_more(found, more)
        steady = [without_jumps(each, found, by[id(each)]) for each in recordings]
        now = drive.of(steady, options)
    found = refined(found, seen, drive.readings.sensors)
    steady = [without_jumps(each, found, by[id(each)]) for each in recordings]
    doubts = tuple(jump_doubt(each, drive.recording) for each in found)
    return with_steady_clocks(steady, now, seen).doubted_before(doubts)


def wandering(jumps: Sequence[SurveyJump]) -> set[str]:
    """Return the sensors whose H jumps so often that it wanders."""
    often = Counter(each.sensor for each in jumps)
    return {sensor for sensor, count in often.items() if count > MOST_JUMPS}


def with_steady_clocks(
    recordings: Sequence[Recording], drive: SuiteDrive, seen: SeenWindows
) -> SteadySurvey:
    """Return recordings, that a drive joins, without what clocks drift by."""
    parts, readings = drive.recording.parts, drive.readings
    starts = [
        part.trajectory.stamp_ns[0] + by - 1
        for part, by in zip(parts, drive.recording.moved_ns or (0,), strict=True)
    ]
    of = np.maximum(np.searchsorted(starts, readings.stamp_ns) - 1, 0)
    found = clock_drifts(seen, since_middle(readings.stamp_ns, of)).found
    rates = {
        name: rate for name, rate in zip(readings.sensors, found.tolist(), strict=True) if rate
    }
    doubts = tuple(
        f"the clock of {name} drifts against that of the poses, by {1e5 * rate:.0f} ms in 100 s; "
        "its stamps were corrected by that. Stamp readings and poses by one clock"
        for name, rate in rates.items()
    )
    return SteadySurvey([steadied(each, rates) for each in recordings], doubts)


def jump_doubt(jump: SurveyJump, recording: Recording) -> str:
    """Return when H of a sensor jumped in a survey, and what was done about it."""
    own = recording.drives[drive_at(recording, jump.stamp_ns)] if recording.drives else recording
    seconds = 1e-9 * (own_ns(recording, jump.stamp_ns) - int(own.trajectory.stamp_ns[0]))
    size, (x, y, z) = np.linalg.norm(jump.change), jump.change.tolist()
    corrected = "before" if jump.right_after else "after"
    return (
        f"H of {jump.sensor} jumped by {size:.2g} uT, {seconds:.0f} s after the start of "
        f"{Path(own.source.path).name}: ({x:.2f}, {y:.2f}, {z:.2f}) uT along its x, y, z; its "
        f"readings {corrected} that were corrected. Something magnetic was laid near it, taken "
        "away or switched: leave the vehicle as it is during a survey"
    )
