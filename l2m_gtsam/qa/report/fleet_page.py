"""The fleet's page: one file that needs nothing else."""

import hashlib
import re
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import quote

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from scipy.spatial.transform import Rotation

from l2m_gtsam.qa.fleet import verdict_histories
from l2m_gtsam.qa.options import FleetOptions
from l2m_gtsam.qa.report.figures.trends import SIGMAS, Trend, trend_figure, trends
from l2m_gtsam.qa.report.page import Picture, own_file, render, roll_pitch_yaw
from l2m_gtsam.qa.report.svg import SETTINGS
from l2m_gtsam.records.fleet import ERROR, FleetRow, SensorRow
from l2m_gtsam.text import by_sigma, sigma_alone, with_sigma

REPORT = "report.html"  # in the folder of each drive


@dataclass(frozen=True)
class Tally:
    """Counts for the top of the page and the command line.

    Attributes
    ----------
    drives, vehicles
        Of the fleet.
    failed
        Drives that were not calibrated.
    passed, warned, rejected
        Sensors on drives with the verdict PASS, WARN and FAIL.
    outliers
        Sensors on drives that are marked.
    """

    drives: int
    vehicles: int
    failed: int
    passed: int
    warned: int
    rejected: int
    outliers: int

    @property
    def level(self) -> str:
        """The worst of all."""
        if self.failed or self.rejected:
            return "fail"
        return "warn" if self.warned or self.outliers else "pass"


def tally(rows: Sequence[FleetRow]) -> Tally:
    """Count drives and verdicts."""
    verdicts = [row.verdict for row in rows]
    return Tally(
        drives=len({row.folder for row in rows}),
        vehicles=len({row.vehicle for row in rows}),
        failed=verdicts.count(ERROR),
        passed=verdicts.count("pass"),
        warned=verdicts.count("warn"),
        rejected=verdicts.count("fail"),
        outliers=sum(bool(row.outliers) for row in rows),
    )


def fleet_page(rows: Sequence[FleetRow], options: FleetOptions) -> str:
    """Return the page of a fleet as HTML.

    Text from bags and names of files are escaped; nothing is loaded from anywhere, and no script
    runs but the page's own, whose digest its policy names.

    Parameters
    ----------
    rows
        With their outliers, in the order in which they are shown.
    options
        Of the fleet.
    """
    all_trends = trends(rows)
    drawn = _chosen(all_trends, options.pictures)
    script = own_file("sort.js")
    with mpl.rc_context(SETTINGS):
        return render(
            "fleet.html.j2",
            rows=rows,
            coordinates=_coordinates,
            turned=_turned,
            link=_link,
            count=tally(rows),
            failed=[row for row in rows if row.verdict == ERROR],
            outlying=[row for row in rows if row.outliers],
            pictures=[
                (each, Picture(f"trend-{k}", trend_figure(each))) for k, each in enumerate(drawn)
            ],
            histories=verdict_histories(rows),
            small=_small,
            bars=SIGMAS,
            left_out=len(all_trends) - len(drawn),
            options=options,
            style=own_file("style.css") + own_file("fleet.css"),
            script=script,
            digest=b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        )


def _chosen(found: Sequence[Trend], most: int) -> list[Trend]:
    """Return as many trends as are drawn, in their order; those with outliers go first."""
    first = sorted(range(len(found)), key=lambda k: -found[k].outliers)[:most]
    return [found[k] for k in sorted(first)]


def _small(svg: Markup) -> Markup:
    """Return SVG without its indentation: a page has many."""
    return Markup(re.sub(r"\n\s*", "\n", svg))  # noqa: S704 - it is safe as it comes


def _coordinates(sensor: SensorRow) -> list[tuple[str, str]]:
    """Return x, y and z in millimetres as a cell sorts, and as it reads."""
    pairs = zip(sensor.t, sensor.t_sigma, strict=True)
    return [(f"{1e3 * value:.3f}", with_sigma(1e3 * value, 1e3 * s)) for value, s in pairs]


def _turned(sensor: SensorRow) -> str:
    """Return roll, pitch and yaw, and the largest sigma, in degrees."""
    if not np.isfinite(sensor.quaternion_xyzw).all():
        return "–"
    roll, pitch, yaw = roll_pitch_yaw(Rotation.from_quat(sensor.quaternion_xyzw))
    sigma = max(sensor.rotation_sigma)
    if not np.isfinite(sigma):
        return f"{roll:.1f}, {pitch:.1f}, {yaw:.1f}, part of it not determined"
    angles = ", ".join(by_sigma(each, sigma) for each in (roll, pitch, yaw))
    return f"{angles} ± {sigma_alone(sigma)}"


def _link(row: FleetRow) -> str:
    """Return where the report of a row is, as seen from the page."""
    return quote(f"{row.folder}/{REPORT}")
