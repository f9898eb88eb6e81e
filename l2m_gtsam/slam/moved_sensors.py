"""A sensor that is no longer as calibrated: which of several, and what a drive is without it.

A sensor that was moved draws the poses with it, and readings of all others seem wrong then. Its
refined calibration tells: it contradicts the one given. So do, less, those of sensors beside it.
The drive without it decides: there the others are as they were calibrated.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from l2m_gtsam.data import Recording
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.localisation import LocalisationResult
from l2m_gtsam.slam.pose_graph import stated_information_root
from l2m_gtsam.solve.chi_square import exceeded_by

PARAMETERS = 15
# Of a sound sensor's change; that of sensors whose sigmas are somewhat small is beyond it, too.
CHANCE = 1e-9
LARGEST = float(exceeded_by(CHANCE, PARAMETERS))
PLAINER = 4.0  # times, beyond all other sensors, and beyond what is left without it
MOST = 3  # sensors that are tried


@dataclass(frozen=True)
class MovedSensor:
    """Which sensor is no longer as calibrated, and by how much its calibration changed.

    Attributes
    ----------
    sensor
        Its name.
    change
        See ``calibration_changes``.
    """

    sensor: str
    change: float

    def warning(self) -> str:
        """Return that it is contradicted, as an event."""
        return (
            f"{self.sensor} contradicts its calibration (chi-square {self.change:.0f} of "
            f"{PARAMETERS}): it was moved, its iron changed, or the place is another one; poses "
            "may be off by far more than their sigmas. Calibrate it anew, or leave it out "
            "(`bag.fields`)"
        )

    def note(self) -> str:
        """Return that it is left out, as a note."""
        return (
            f"{self.sensor} is left out: with it poses would contradict its calibration "
            f"(chi-square {self.change:.0f} of {PARAMETERS}), without it those of the other "
            "sensors hold. It was moved, or its iron changed; calibrate it anew"
        )


def calibration_changes(before: CalibrationResult, result: LocalisationResult) -> dict[str, float]:
    """Return the change of each refined calibration, squared, by the covariance before.

    At most chi-square of ``PARAMETERS`` where that covariance was true; empty where none is
    refined.
    """
    after = result.calibration
    if after is None:
        return {}
    names = [each.sensor for each in result.sensors]
    return {name: calibration_change(before[name], after[name]) for name in names}


def calibration_change(before: SensorCalibration, after: SensorCalibration) -> float:
    """Return the same of one sensor."""
    white = stated_information_root(before.covariance) @ (after.vector() - before.vector())
    return float(white @ white)


def sensor_to_leave_out(
    changes: dict[str, float], without: Callable[[str], dict[str, float]]
) -> MovedSensor | None:
    """Return the sensor without which those that are left hold.

    None where no calibration changed by more than chance, or several sensors alike.

    Parameters
    ----------
    changes
        Of all S sensors.
    without
        Gives those of the others once a sensor is left out; empty where they determine nothing.
    """
    most = max(changes.values(), default=0.0)
    if len(changes) < 2 or most < LARGEST:
        return None
    suspects = sorted(
        (name for name, change in changes.items() if PLAINER * change > most),
        key=lambda name: -changes[name],
    )
    if len(suspects) > MOST or len(suspects) == len(changes) > 2:  # it is the map, or the start
        return None
    left = dict[str, float]()
    for name in suspects:
        left[name] = max(without(name).values(), default=most)
        # Of three and more those that are left contradict each other if the wrong one is out.
        if len(changes) > 2 and left[name] < LARGEST:
            return MovedSensor(name, changes[name])
    name = min(left, key=lambda each: left[each])
    others = (value for each, value in left.items() if each != name)
    if PLAINER * left[name] > min([most, *others]):
        return None
    return MovedSensor(name, changes[name])


def without_series(recording: Recording, sensors: Iterable[str]) -> Recording:
    """Return a recording without the readings of some sensors."""
    named = set(sensors)
    series = tuple(each for each in recording.series if each.sensor not in named)
    return replace(recording, series=series)
