"""When a drive was made, as far as its stamps tell."""

from datetime import UTC, datetime

from l2m_gtsam.data import Recording
from l2m_gtsam.records.map_diary import UNDATED, MapDrive

# The years 2000 to 2100: clocks that were never set begin in 1970.
CREDIBLE_NS = 946_684_800 * 10**9, 4_102_444_800 * 10**9


def drive_dates(*recordings: Recording) -> MapDrive:
    """Return first and last pose of drives; undated if a stamp is no date of this century."""
    begun = min(int(each.trajectory.stamp_ns.min()) for each in recordings)
    ended = max(int(each.trajectory.stamp_ns.max()) for each in recordings)
    if begun < CREDIBLE_NS[0] or ended > CREDIBLE_NS[1]:
        return UNDATED
    return MapDrive(in_utc(begun), in_utc(ended))


def in_utc(stamp_ns: int) -> str:
    """Return a stamp in nanoseconds as ISO date and time, to the second."""
    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
