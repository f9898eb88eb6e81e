"""What is known of a bag and its topics."""

from dataclasses import dataclass
from pathlib import Path

from l2m_gtsam.storage.units import Strength, Units

POSE_FILE = "file"
"""Type of what stands for a file with poses among topics."""


@dataclass(frozen=True)
class TopicReport:
    """What is known of one topic.

    Attributes
    ----------
    topic, msgtype
        Name and type.
    frames
        Frames of its headers; empty where messages were not decoded.
    count
        Messages.
    rate_hz
        One over the median time between header stamps; of topics that are not decoded, messages
        over the time of the bag.
    longest_gap_s
        Longest time between messages.
    span_s
        First and last header stamp in seconds.
    clock_offset_s
        Median of record time less header stamp in seconds.
    nan_share
        Share of readings with a NaN axis; NaN for other types.
    strength
        |B| in uT, for magnetic fields in a unit that is known.
    use
        What would be used of it, and why, or why not.
    role
        `field`, `poses` or empty: what it would be used as.
    likely_units
        What its readings are likely in, where they are not in the unit of their type.
    links
        Parents and children of its transforms.
    """

    topic: str
    msgtype: str
    frames: tuple[str, ...]
    count: int
    rate_hz: float
    longest_gap_s: float
    span_s: tuple[float, float]
    clock_offset_s: float
    nan_share: float
    strength: Strength | None
    use: str
    role: str = ""
    likely_units: Units | None = None
    links: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class BagReport:
    """What is in a bag: its topics, what prevents its use, if anything, and what else to know."""

    path: Path
    topics: tuple[TopicReport, ...]
    obstacles: tuple[str, ...]
    notes: tuple[str, ...] = ()
