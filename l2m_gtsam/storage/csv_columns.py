"""Which columns of a table are what, by their names or as the options say."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from l2m_gtsam.storage.bag_options import ColumnOptions, TimeUnit
from l2m_gtsam.storage.units import Unit

# Endings of names, in brackets or after an underscore.
FIELD_UNITS = {
    "t": Unit.TESLA,
    "tesla": Unit.TESLA,
    "mt": Unit.MILLITESLA,
    "ut": Unit.MICROTESLA,
    "µt": Unit.MICROTESLA,
    "μt": Unit.MICROTESLA,
    "microtesla": Unit.MICROTESLA,
    "nt": Unit.NANOTESLA,
    "nanotesla": Unit.NANOTESLA,
    "g": Unit.GAUSS,
    "ga": Unit.GAUSS,
    "gs": Unit.GAUSS,
    "gauss": Unit.GAUSS,
    "mg": Unit.MILLIGAUSS,
    "mgauss": Unit.MILLIGAUSS,
    "milligauss": Unit.MILLIGAUSS,
}
TESLAS = (Unit.MILLITESLA, Unit.MICROTESLA, Unit.NANOTESLA)
TIME_UNITS = {
    **{each.value: each for each in TimeUnit if each is not TimeUnit.AUTO},
    "sec": TimeUnit.SECONDS,
    "secs": TimeUnit.SECONDS,
    "seconds": TimeUnit.SECONDS,
    "msec": TimeUnit.MILLISECONDS,
    "usec": TimeUnit.MICROSECONDS,
    "µs": TimeUnit.MICROSECONDS,
    "nsec": TimeUnit.NANOSECONDS,
    "nsecs": TimeUnit.NANOSECONDS,
}
# In order of preference; what ends in one of the first is a message's own stamp.
STAMPS = (
    *("header.stamp", "header/stamp", "timestamp_sample", "timeintervalsince1970"),
    *("timestamp", "timestamps", "stamp", "__time"),
)
MORE_STAMPS = ("time", "t", "datetime", "seconds_elapsed", "elapsed")
TIMES = ("time", "datetime", "elapsed")  # last words; t may be a translation
BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*((?:[^\d\])][^\])]*)?)\s*[\])]\s*$")
AXIS = re.compile(r"^(.*?)[\s._/\-]*([wxyz])$")
INDEX = re.compile(r"^(.*?)\[([0-2])\]$")
WORDS = re.compile(r"[\s._/\-]+")
FIELDS = ("b", "m", "h")
QUATERNIONS = ("q", "quat", "quaternion", "orientation")
POSITIONS = ("p", "pos", "position", "t", "trans", "translation", "")


@dataclass(frozen=True)
class Name:
    """The name of a column: what it is called, and the unit that it states."""

    text: str
    unit: str


@dataclass(frozen=True)
class FieldColumns:
    """Columns x, y and z of a magnetometer, and the unit that they state."""

    columns: tuple[int, ...]
    unit: Unit | None


@dataclass(frozen=True)
class Roles:
    """What the columns of a table are.

    Attributes
    ----------
    stamp
        Column of the times; two for seconds and nanoseconds.
    time_unit
        Of the times, as their name has it.
    fields
        Magnetometers by name.
    position, orientation
        Columns of poses, if there are any: x, y, z and x, y, z, w.
    left_out
        Groups of columns that are of no use as one of them is missing, a clause each.
    """

    stamp: tuple[int, ...]
    time_unit: TimeUnit
    fields: Mapping[str, FieldColumns]
    position: tuple[int, ...] | None
    orientation: tuple[int, ...] | None
    left_out: tuple[str, ...] = ()


def column_roles(names: Sequence[str], options: ColumnOptions, stem: str) -> Roles:
    """Return what columns are.

    Parameters
    ----------
    names
        As they stand in the first line.
    options
        What is known of them.
    stem
        Of the file's name: that of a magnetometer whose columns are x, y and z only.

    Raises
    ------
    ValueError
        A column that the options name is missing, or none has the times.
    """
    parts = [_parts(name) for name in names]
    stamp, unit = _stamp(names, parts, options)
    axes_of = _groups(parts, stamp)
    vectors = {base: axes for base, axes in axes_of.items() if {"x", "y", "z"} <= set(axes)}
    bare = "mag" in stem.lower() or _states_tesla(parts, vectors.get("", {}))
    magnetic = {base: axes for base, axes in vectors.items() if _is_magnetic(base, bare)}
    others = {base: axes for base, axes in vectors.items() if base not in magnetic}
    positions = (
        tuple(axes[each] for each in "xyz")
        for base, axes in others.items()
        if (_last(base) in POSITIONS or base.startswith("p_")) and "w" not in axes
    )
    orientations = (
        tuple(axes[each] for each in "xyzw") for axes in vectors.values() if "w" in axes
    )
    roles = Roles(
        stamp,
        unit if options.time_unit is TimeUnit.AUTO else options.time_unit,
        _fields(names, parts, magnetic, options, stem),
        _chosen(names, options.position, positions),
        _chosen(names, options.orientation, orientations),
        _left_out(names, parts, axes_of, options),
    )
    _check_stamp(names, roles)
    return roles


def _check_stamp(names: Sequence[str], roles: Roles) -> None:
    """Raise a ValueError if the options have the times as an axis, too."""
    fields = [(f"magnetometer {name}", each.columns) for name, each in roles.fields.items()]
    poses = [("position", roles.position or ()), ("orientation", roles.orientation or ())]
    for what, columns in [*fields, *poses]:
        for column in {*roles.stamp} & {*columns}:
            raise ValueError(
                f"column {names[column].strip()!r} has the times, it is no axis of the {what}; "
                "name others with `columns`"
            )


def _parts(name: str) -> Name:
    """Return a name without decoration, and the unit in brackets after it."""
    plain = name.strip().strip("\ufeff#%\"' ").strip()
    with_unit = BRACKETS.match(plain)
    text, unit = (with_unit[1], with_unit[2]) if with_unit else (plain, "")
    return Name(text.lower(), unit.strip().lower())


def _place(names: Sequence[str], wanted: str) -> int:
    """Return the column of a name that the options give."""
    plain = [name.strip().strip("\ufeff") for name in names]
    if wanted not in plain:
        raise ValueError(f"no column {wanted!r}; there are: {', '.join(plain[:30])}")
    return plain.index(wanted)


def _places(names: Sequence[str], wanted: Sequence[str]) -> tuple[int, ...]:
    return tuple(_place(names, each) for each in wanted)


def _stamp(
    names: Sequence[str], parts: Sequence[Name], options: ColumnOptions
) -> tuple[tuple[int, ...], TimeUnit]:
    if options.stamp is not None:
        column = _place(names, options.stamp)
        return (column,), _time_unit(parts[column])
    for ending in STAMPS:
        found = [k for k, part in enumerate(parts) if _timeless(part.text).endswith(ending)]
        if found:
            return (found[0],), _time_unit(parts[found[0]])
    for base in ("stamp.", "stamp/", "stamp_"):
        seconds, rest = (
            [k for k, part in enumerate(parts) if part.text.endswith(base + ending)]
            for ending in ("sec", "nanosec")
        )
        if seconds and rest:
            return (seconds[0], rest[0]), TimeUnit.SECONDS
    for wanted in MORE_STAMPS:
        for k, part in enumerate(parts):
            if _timeless(part.text) == wanted:
                return (k,), _time_unit(part)
    raise ValueError(
        "no column with times is known by its name; name it with `columns.stamp`, under `bag` "
        "for a log, under `bag.pose_file` for poses; there are: "
        f"{', '.join(part.text for part in parts[:30])}"
    )


def _timeless(text: str) -> str:
    """Return a name without a unit of time after an underscore: stamp_ns."""
    head, _, ending = text.rpartition("_")
    return head if head and ending in TIME_UNITS else text


def _time_unit(name: Name) -> TimeUnit:
    ending = name.text.rpartition("_")[2]
    return TIME_UNITS.get(name.unit) or TIME_UNITS.get(ending) or TimeUnit.AUTO


def _left_out(
    names: Sequence[str],
    parts: Sequence[Name],
    groups: Mapping[str, Mapping[str, int]],
    options: ColumnOptions,
) -> tuple[str, ...]:
    if options.fields or options.position or options.orientation:
        return ()  # whoever names columns knows them
    found = list[str]()
    texts = {part.text for part in parts}
    turned = any({"x", "y", "z", "w"} <= set(axes) for axes in groups.values())
    for base, axes in groups.items():
        if f"{base}[3]" in texts:  # numbered, the scalar first or last
            continue
        wanted = "xyzw" if _last(base) in QUATERNIONS else "xyz"
        likely = wanted == "xyzw" or _is_magnetic(base, bare=False)
        likely |= turned and _last(base) in POSITIONS
        missing = [axis for axis in wanted if axis not in axes]
        if likely and len(missing) == 1:
            known = ", ".join(names[column].strip() for column in sorted(axes.values()))
            found.append(f"{known} without the one of {missing[0]}")
    return tuple(found)


def _groups(parts: Sequence[Name], stamp: tuple[int, ...]) -> dict[str, dict[str, int]]:
    """Return columns, but those of the times, by what stands before their axis, and the axis."""
    found: dict[str, dict[str, int]] = {}
    for k, part in enumerate(parts):
        if k in stamp:
            continue
        if match := INDEX.match(part.text):
            found.setdefault(match[1], {}).setdefault("xyz"[int(match[2])], k)
        elif match := AXIS.match(_without_unit(part.text)):
            found.setdefault(match[1], {}).setdefault(match[2], k)
    return found


def _without_unit(text: str) -> str:
    """Return a name without a unit of field after an underscore: mag_x_ut."""
    head, _, ending = text.rpartition("_")
    return head if head and ending in FIELD_UNITS and AXIS.match(head) else text


def _last(base: str) -> str:
    """Return the last word of a name."""
    return WORDS.split(base)[-1] if base else ""


def _fields(
    names: Sequence[str],
    parts: Sequence[Name],
    vectors: Mapping[str, Mapping[str, int]],
    options: ColumnOptions,
    stem: str,
) -> dict[str, FieldColumns]:
    if options.fields:
        found = {label: _places(names, wanted) for label, wanted in options.fields.items()}
    else:
        found = {
            "_".join(filter(None, WORDS.split(base))) or stem: tuple(axes[each] for each in "xyz")
            for base, axes in vectors.items()
            if "w" not in axes
        }
    return {
        label: FieldColumns(columns, _field_unit(parts[columns[0]]))
        for label, columns in found.items()
    }


def _is_magnetic(base: str, bare: bool) -> bool:
    """Return whether a name is that of a magnetometer; of columns x, y and z alone it is given."""
    if "cov" in base or base.endswith(STAMPS) or _last(base) in TIMES:
        return False
    if base == "":
        return bare
    return "mag" in base or _last(base) in FIELDS


def _states_tesla(parts: Sequence[Name], axes: Mapping[str, int]) -> bool:
    """Return whether columns state a unit that nothing but a magnetic field has."""
    units = [FIELD_UNITS.get(parts[column].unit) for column in axes.values()]
    return bool(units) and all(unit in TESLAS for unit in units)


def _field_unit(name: Name) -> Unit | None:
    ending = name.text.rpartition("_")[2] if _without_unit(name.text) != name.text else ""
    if name.text.startswith(("magnetometer_ga",)):
        return Unit.GAUSS
    return FIELD_UNITS.get(name.unit) or FIELD_UNITS.get(ending)


def _chosen(
    names: Sequence[str], given: Sequence[str] | None, found: Iterable[tuple[int, ...]]
) -> tuple[int, ...] | None:
    """Return the columns that the options give, else the first that were found."""
    return next(iter(found), None) if given is None else _places(names, given)
