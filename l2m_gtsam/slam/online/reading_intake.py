"""Readings of all sensors as they come: what cannot be used is refused and reported."""

from collections.abc import Mapping

import numpy as np

from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.errors import InputError
from l2m_gtsam.slam.localisation import left_out, why_unusable
from l2m_gtsam.slam.online.events import EventKind, OnlineEvent
from l2m_gtsam.slam.online.sensor_buffer import SensorBuffer
from l2m_gtsam.slam.online.stamp_order import NS, require_stamp, seconds_ahead

# No magnetometer of a vehicle reads less or more: those in gauss seem to, or in nanotesla.
READ_UT = (1.0, 2000.0)
MOST_STRANGERS = 512  # sensors without a calibration that are reported
TEXTS = {
    EventKind.OUT_OF_ORDER: "has readings that are older than those before them: they are left out",
    EventKind.SENSOR_BACK: "has readings again",
    EventKind.SENSOR_STUCK: "repeats one value while the vehicle moves: it is left out",
    EventKind.SENSOR_SILENT: "sends nothing",
}


class ReadingIntake:
    """Keeps readings until their key pose is made.

    Parameters
    ----------
    names
        Of the S calibrated sensors.
    unusable
        Why the calibrations of other sensors cannot be used, clauses by name.

    Attributes
    ----------
    buffers
        Of the S sensors: all that is remembered of them.
    """

    def __init__(self, names: tuple[str, ...], unusable: Mapping[str, str]) -> None:
        self._names, self._unusable = names, unusable
        self.buffers = [SensorBuffer() for _ in names]
        # Sensors that were reported: of no calibration, to read no field, to be ahead of odometry.
        self._strangers, self._implausible, self._ahead = set[str](), set[str](), set[str]()
        self._events: list[OnlineEvent] = []

    def events(self) -> list[OnlineEvent]:
        """Return what happened since the last call."""
        found, self._events = self._events, []
        return found

    def add(
        self,
        stamp_ns: int,
        sensor: str,
        value: FloatArray,
        first_ns: int | None,
        last_ns: int | None,
    ) -> None:
        """Take a reading in uT.

        One that is not finite, no field in that unit, late, or of another sensor is left out.

        Parameters
        ----------
        stamp_ns, sensor, value
            Time, name and reading, shape (3,).
        first_ns
            Time of the last key pose; none before the first.
        last_ns
            Time of the last pose of odometry; none before the first.

        Raises
        ------
        InputError
            The stamp is no number of nanoseconds, or the reading is not of shape (3,).
        """
        require_stamp(stamp_ns)
        if sensor not in self._names:
            if len(self._strangers) < MOST_STRANGERS:
                text = left_out(sensor, self._unusable.get(sensor) or why_unusable(None))
                self._report_once(self._strangers, sensor, stamp_ns, EventKind.UNUSABLE, text)
            return
        own = np.array(value, dtype=np.float64)
        if own.shape != (3,):
            raise InputError(f"a reading of {sensor}: of shape {own.shape}; needed is (3,)")
        if not np.isfinite(own).all():
            return
        strength = float(np.linalg.norm(own))
        if not READ_UT[0] <= strength <= READ_UT[1]:
            text = (
                f"{sensor} reads {strength:.4g} where microtesla are wanted: is it in another "
                "unit? Such readings are left out"
            )
            self._report_once(self._implausible, sensor, stamp_ns, EventKind.UNUSABLE, text)
            return
        if ahead := seconds_ahead(stamp_ns, last_ns):
            text = f"a reading of {sensor} is stamped {ahead:.1f} s ahead of odometry: left out"
            self._report_once(self._ahead, sensor, stamp_ns, EventKind.OUT_OF_ORDER, text)
            return
        self._ahead.discard(sensor)
        buffer = self.buffers[self._names.index(sensor)]
        if first_ns is not None and stamp_ns <= first_ns:
            if not buffer.disordered:
                self._report_sensor(stamp_ns, sensor, EventKind.OUT_OF_ORDER)
            buffer.disordered = True
            return
        before_ns = buffer.last_ns
        for kind in buffer.add(stamp_ns, own):
            self._report_sensor(stamp_ns, sensor, kind)
        if buffer.last_ns < before_ns:
            text = f"a reading of {sensor} is stamped ahead of those after it: left out"
            self._report(before_ns, EventKind.OUT_OF_ORDER, text)

    def take(self, until_ns: int) -> Readings:
        """Remove the readings up to a time, and return them without poses."""
        parts = [buffer.take(until_ns) for buffer in self.buffers]
        sensor = np.repeat(np.arange(len(parts)), [len(stamps) for stamps, _ in parts])
        stamps = np.concatenate([stamps for stamps, _ in parts])
        field = np.concatenate([values for _, values in parts])
        none = np.empty((len(stamps), 3))
        return Readings(self._names, sensor, stamps, np.empty((len(stamps), 3, 3)), none, field)

    def check(self, stamp_ns: int, silent_s: float, *, moved: bool) -> None:
        """Report at a key pose which sensors sent nothing for so long, or one value alone.

        ``moved`` says whether the vehicle has moved since the key pose before.
        """
        silent_ns = round(silent_s / NS)
        for name, buffer in zip(self._names, self.buffers, strict=True):
            for kind in buffer.check(stamp_ns, silent_ns, moved=moved):
                self._report_sensor(stamp_ns, name, kind)

    def _report_once(
        self, reported: set[str], sensor: str, stamp_ns: int, kind: EventKind, text: str
    ) -> None:
        if sensor not in reported:
            reported.add(sensor)
            self._report(stamp_ns, kind, text)

    def _report_sensor(self, stamp_ns: int, sensor: str, kind: EventKind) -> None:
        self._report(stamp_ns, kind, f"{sensor} {TEXTS[kind]}")

    def _report(self, stamp_ns: int, kind: EventKind, text: str) -> None:
        self._events.append(OnlineEvent(stamp_ns, kind, text))
