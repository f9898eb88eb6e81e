"""Everything that can go wrong with a user's input, as one sentence each.

Every message names the offender (file, topic, sensor or key) and says what would be accepted.
The command line prints it as one line and exits with code 2.
"""

from collections.abc import Iterable


class L2MError(Exception):
    """Base of all errors that a user can mend."""


class BagError(L2MError):
    """A recording that cannot be opened, or that lacks what was asked for."""


class UnitsError(L2MError):
    """A field strength that does not fit the unit it is said to be in."""


class InputError(L2MError):
    """An array or an argument that is not what it should be."""


class NoSuchNameError(InputError, KeyError):
    """A name that is not there, where what is there is asked by name, as in a dict."""

    __str__ = Exception.__str__  # that of a KeyError puts the line in quotes

    @classmethod
    def of(cls, name: object, there: Iterable[str]) -> "NoSuchNameError":
        """Return the error of a name beside the names that are there."""
        return cls(f"no sensor named {name!r}; there are {', '.join(there) or 'none'}")


class SyncError(L2MError):
    """Readings and poses that cannot be brought together in time."""


class MapError(L2MError):
    """A map that cannot be built, read or queried where it was asked."""


class CalibrationError(L2MError):
    """A calibration that cannot be started or read."""


class ConfigError(L2MError):
    """A configuration key or value that is not understood."""


class OutputError(L2MError):
    """A result that cannot be written."""


class NoRoomError(OutputError):
    """A disk or a quota that is full: nothing else can be written there either."""


class ClusterError(L2MError):
    """Work that cannot be shared out."""


class PeerError(L2MError):
    """A peer of a study that is not installed, or that cannot be run on what it is given."""


class LidarError(L2MError):
    """Poses that cannot be had from point clouds."""


class Notice(UserWarning):
    """One line, such as that of a file that was damaged and is made anew."""
