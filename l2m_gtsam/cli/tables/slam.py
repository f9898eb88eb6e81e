"""A localisation as tables in the terminal."""

import numpy as np
from rich.markup import escape
from rich.table import Table

from l2m_gtsam.batch.online_slam import OnlineOutcome
from l2m_gtsam.cli.tables import new_table
from l2m_gtsam.geometry import to_ros
from l2m_gtsam.records.localisation import Gain, LocalisationResult, ScanUse, StartSearch
from l2m_gtsam.records.localisation_file import TruthRecord
from l2m_gtsam.text import significant

MOST_EVENTS = 20  # that are printed


def slam_table(result: LocalisationResult) -> Table:
    """Return one row per sensor: what its readings were worth."""
    counts = ("on key poses", "rejected", "outside map")
    table = new_table("Readings", ("sensor",), ["rms per axis (uT)", "chi2 per dof", *counts])
    for each in result.sensors:
        table.add_row(
            escape(each.sensor),
            significant(each.rms),
            f"{each.chi2_per_dof:.2f}",
            str(each.readings),
            str(each.rejected),
            str(each.outside_map),
        )
    return table


def start_lines(search: StartSearch | None) -> tuple[str, ...]:
    """Return where the drive was found to begin, a line each; none where that was known."""
    if search is None:
        return ()
    best = search.candidates[0]
    sigma = np.sqrt(np.diag(best.covariance))
    second = "no second place was found"
    if np.isfinite(search.margin):
        second = f"the second best place is less likely by exp({search.margin:.0f})"
    place = f"{1e3 * sigma[3:].max():.0f} mm and {np.rad2deg(sigma[:3].max()):.1f} deg (one sigma)"
    searched = f"{second}; {search.looked_at} places and headings were looked at"
    return f"start: {search.message}", f"start known within {place}; {searched}"


def drift_lines(result: LocalisationResult) -> tuple[str, ...]:
    """Return how far odometry had drifted and how well poses are known, a line each."""
    drift, covariance = result.drift, result.trajectory.covariance
    drifted = (
        f"{len(result.trajectory)} key poses over {drift.way_m:.1f} m; odometry ended "
        f"{drift.end_m:.2f} m and {drift.end_deg:.1f} deg off ({drift.end_share:.1%} of the path), "
        f"{drift.largest_m:.2f} m at most"
    )
    lines = [f"{result.status.value}: {result.message}", drifted]
    if covariance is not None:
        in_map = to_ros(covariance, result.trajectory.R)[:, :3, :3]
        sigma = 1e3 * np.sqrt(np.diagonal(in_map, axis1=1, axis2=2).max(axis=1))
        known = (
            f"positions are known to {significant(np.median(sigma), 2)} mm in the median, "
            f"{significant(sigma.max(), 2)} mm at worst (1 sigma along the worst axis)"
        )
        lines.append(known)
    return tuple(lines)


def scan_lines(scans: ScanUse | None) -> tuple[str, ...]:
    """Return what scans were worth, a line; none without scans."""
    if scans is None:
        return ()
    line = (
        f"scans: {scans.fixes} fixes in the map and {scans.loops} loops counted (chi2 per dof "
        f"{scans.chi2_per_dof:.2f}), {scans.rejected} were rejected"
    )
    return (line,)


def gain_lines(gain: Gain | None) -> tuple[str, ...]:
    """Return what the correction of odometry is worth, a line; none where there was a map."""
    if gain is None:
        return ()
    return (f"{'gained' if gain.shown else 'no gain shown'}: {gain.reason}",)


def online_lines(done: OnlineOutcome) -> tuple[str, ...]:
    """Return what came of a drive on line: notes, the last events, key poses, time and memory."""
    cost = 1e3 * done.cost_s
    events = [
        f"{1e-9 * each.stamp_ns:.3f} {each.event[0]}: {each.event[1]}"
        for each in done.events
        if each.event is not None
    ]
    more = len(events) - MOST_EVENTS
    left = (f"... and {more} more events before them, in online.jsonl",) if more > 0 else ()
    if not len(cost):
        nowhere = "no key pose has a place: the start was not found"
        return (*done.notes, *left, *events[-MOST_EVENTS:], nowhere)
    summary = (
        f"{len(done.trajectory)} key poses on line, {done.times_real:.1f} times real time; "
        f"processor ms per key pose: {np.median(cost):.1f} in the middle, "
        f"{np.quantile(cost, 0.99):.1f} at the 99th percentile, {cost.max():.0f} at most; at most "
        f"{done.peak_mib:.0f} MiB"
    )
    return (*done.notes, *left, *events[-MOST_EVENTS:], summary)


def truth_lines(truth: TruthRecord | None) -> tuple[str, ...]:
    """Return errors against the truth before and after, a line each; none without a truth."""
    if truth is None:
        return ()
    before, after = truth.odometry, truth.localised
    errors = (
        f"against the truth at {truth.poses} key poses: odometry {1e3 * before.rms_m:.0f} mm rms, "
        f"{1e3 * before.largest_m:.0f} mm at most; {_scanned(truth)}localised "
        f"{1e3 * after.rms_m:.0f} mm rms, {1e3 * after.largest_m:.0f} mm at most{_gone(truth)}"
    )
    nees = (
        f"rotations {before.rms_deg:.2f} deg rms before, {after.rms_deg:.2f} deg after; NEES of "
        f"the poses {truth.nees:.1f}, expected 6"
    )
    return (errors, nees)


def _scanned(truth: TruthRecord) -> str:
    each = truth.by_scans
    if each is None:
        return ""
    return f"with scans {1e3 * each.rms_m:.0f} mm rms, {1e3 * each.largest_m:.0f} mm at most; "


def _gone(truth: TruthRecord) -> str:
    gone = truth.removed
    if np.isnan(gone):  # odometry is the truth itself
        return ""
    return f" ({abs(gone):.0%} {'less' if gone >= 0 else 'more'})"
