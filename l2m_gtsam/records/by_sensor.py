"""Records with an entry per sensor, which are asked by name as a dict is."""

from collections.abc import Iterator
from typing import Generic, Protocol, TypeVar

from l2m_gtsam.errors import NoSuchNameError


class OfSensor(Protocol):
    """What says of which sensor it is."""

    @property
    def sensor(self) -> str:
        """Name of the sensor."""


Entry = TypeVar("Entry", bound=OfSensor)


class BySensor(Generic[Entry]):
    """A record of ``sensors``: ``record[name]``, ``name in record``, ``for name in record``.

    Asking for a name that is not there is a NoSuchNameError.
    """

    sensors: tuple[Entry, ...]

    def __getitem__(self, sensor: str) -> Entry:
        for entry in self.sensors:
            if entry.sensor == sensor:
                return entry
        raise NoSuchNameError.of(sensor, self)

    def __iter__(self) -> Iterator[str]:
        return (entry.sensor for entry in self.sensors)

    def __contains__(self, sensor: object) -> bool:
        return any(entry.sensor == sensor for entry in self.sensors)
