"""Twenty names that are code, markup or control characters, and what has such names."""

from dataclasses import replace

from l2m_gtsam.records.fleet import FleetRow
from l2m_gtsam.records.localisation_file import LocalisationRecord
from l2m_gtsam.records.provenance import NamedSource
from tests.drives.fleet_rows import row, sensor_row
from tests.drives.localised import record

NAMES = (
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(2)>',
    "' onmouseover='alert(3)",
    "</title></svg><script>alert(4)</script>",
    "<!-- ]]> &amp; &#60;b&#62;",
    "javascript:alert(5)",
    "{{ 7 * 7 }}{% for x in y %}",
    "${HOME} $(touch touched) `touch touched`",
    "%s%n %(x)d {0} {x.y}",
    "$\\frac{\\alpha$ \\input{x}",
    "[red]bold[/] [link=x]",
    "=cmd|' /C calc'!A0",
    "!!python/object/apply:os.system [x]",
    "'; DROP TABLE topics; --",
    "../../../etc/passwd",
    "C:\\con\\..\\nul.",
    "\x1b[31mred\x1b]0;title\x07",
    "\u202egnp.exe\u200b\ufeff",
    "line\r\nl2m: all is well",
    "n" * 400,
)


def fleet_rows() -> list[FleetRow]:
    """Return drives whose vehicle, bag, sensor, reason and error are such names."""
    found = []
    for k, name in enumerate(NAMES):
        sensor = sensor_row(name, reason=name)
        found += [row(day, sensor, vehicle=name, bag=f"{name}.bag") for day in range(2)]
        found.append(replace(row(4), vehicle=name, sensor=None, error=f"{name}: {NAMES[-k]}"))
    return found


def localisation() -> LocalisationRecord:
    """Return a localisation whose sensors, files and notes have such names."""
    told = record()
    (one, *_), refined = told.sensors, told.refined[:1]
    return replace(
        told,
        sensors=tuple(replace(one, use=replace(one.use, sensor=name)) for name in NAMES[:6]),
        refined=tuple(replace(each, sensor=NAMES[3]) for each in refined),
        notes=tuple(f"{name} is left out" for name in NAMES),
        message=f"the map explains {NAMES[0]}",
        sources=tuple(NamedSource("drive", name, "ab12") for name in NAMES),
        options={"slam": {NAMES[1]: NAMES[0]}},
    )
