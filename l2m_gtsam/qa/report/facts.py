"""What the head of a report says beside the verdict: of what, when, by whom, in which frames."""

from collections.abc import Mapping
from typing import Any

from l2m_gtsam.data import SourceFile
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.map_diary import MapDrive
from l2m_gtsam.records.provenance import NamedSource

ENTRIES = "report"  # of the options
UNSET = "not dated: its clock was not set"
IDENTITY = {
    "translation": [0.0, 0.0, 0.0],
    "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0],
}


def entries_of(options: Mapping[str, Any]) -> dict[str, str]:
    """Return what whoever made a calibration wrote into the head of its report.

    Parameters
    ----------
    options
        Of the calibration; a file of others may hold anything in them.
    """
    entries = options.get(ENTRIES)
    if not isinstance(entries, dict):
        return {}
    return {
        name: text
        for name, text in entries.items()
        if isinstance(name, str) and isinstance(text, str)
    }


def facts_of(result: CalibrationResult) -> dict[str, str]:
    """Return what is shown of a calibration above its verdicts: names, and what they are."""
    return {**entries_of(result.options), **_dates(result)}


def _dates(result: CalibrationResult) -> dict[str, str]:
    several = len(result.recorded) > 1
    facts = {
        f"drive {k + 1} recorded" if several else "drive recorded": period(each.when)
        for k, each in enumerate(result.recorded)
    }
    if result.map_origin is not None:
        facts["map surveyed"] = period(result.map_origin.surveyed)
        if result.map_origin.updated is not None:
            facts["map last updated"] = in_words(result.map_origin.updated)
    if (age := result.map_age_days) is not None:
        facts["age of the map at the drive"] = age_in_words(age)
    return facts


def period(drive: MapDrive) -> str:
    """Return first and last pose of a drive in words."""
    if drive.begun is None or drive.ended is None:
        return UNSET
    ended = in_words(drive.ended)
    if drive.ended[:10] == drive.begun[:10]:
        ended = ended.removeprefix(f"{drive.ended[:10]} ")
    return f"{in_words(drive.begun).removesuffix(' UTC')} to {ended}"


def in_words(date: str) -> str:
    """Return an ISO date and time with words between its parts."""
    return date.replace("T", " ").replace("Z", " UTC")


def age_in_words(days: float) -> str:
    """Return an age in days, or in hours below two days."""
    if days < 0:
        return f"{-days:.1f} days younger than the drive"
    return f"{days:.0f} days" if days >= 2 else f"{24 * days:.1f} hours"


def files_of(result: CalibrationResult) -> list[tuple[str, SourceFile | NamedSource]]:
    """Return what a calibration was made from, and what its map was: what each file was, and it."""
    several = len(result.drives) > 1
    named = [f"drive {k + 1}" if several else "drive" for k in range(len(result.drives))]
    files: list[tuple[str, SourceFile | NamedSource]] = [*zip(named, result.drives, strict=True)]
    files += [
        (f"poses of {name}", each.poses)
        for name, each in zip(named, result.recorded, strict=False)
        if each.poses is not None
    ]
    files += [] if result.map is None else [("map", result.map)]
    made_from = () if result.map_origin is None else result.map_origin.sources
    return [*files, *((f"of the map: {each.role}", each) for each in made_from)]


def lidar_frame(result: CalibrationResult) -> str:
    """Return the name of the frame in which positions of sensors are given; empty if unknown."""
    names = sorted({each.child_frame for each in result.recorded})
    bag = result.options.get("bag")
    moved = bag.get("tracked_to_lidar") if isinstance(bag, dict) else None
    shift = ", moved by bag.tracked_to_lidar" if moved not in (None, IDENTITY) else ""
    return f"{' and '.join(names)}{shift}" if names else ""
