"""Drives in the terminal: what a bag holds, and what a drive will determine."""

from dataclasses import replace

import numpy as np
from rich.markup import escape
from rich.table import Table

from l2m_gtsam.cli.tables import (
    add_numbers,
    add_text,
    held_note,
    new_table,
    plain_table,
    sigmas_cell,
)
from l2m_gtsam.records.plan import DrivePlan, NoiseSource, SensorPlan, Worst
from l2m_gtsam.storage.inspect import BagReport, TopicReport
from l2m_gtsam.text import in_unit, sigma_alone

HEADINGS = ("± t (mm)", "± H (uT)", "± rotation (deg)", "± clock (ms)")
OTHERS = ("± C by column", "assumed t (m)", "readings", "outside map")
UNITS = {"t": (1e3, "mm"), "C": (1.0, ""), "H": (1.0, "uT")}


def plan_table(plan: DrivePlan) -> Table:
    """Return one row per sensor: sigmas of position, C, H and rotation, and what stays open."""
    title = f"What this drive will determine, with a noise of {plan.noise:.3g} uT"
    caption = "sigmas; of C the largest of each column; - is not determined"
    table = new_table(title, ("sensor",), HEADINGS[:3], caption)
    add_text(table, "not determined", 14)
    add_numbers(table, (*HEADINGS[3:], *OTHERS))
    for sensor in plan.sensors:
        table.add_row(*_sensor_row(sensor))
    return table


def held_plan_note(plan: DrivePlan) -> str:
    """Return of which sensors time offsets will be taken as zero and why; else nothing."""
    held = [each for each in plan.sensors if each.offset_held]
    return held_note({each.sensor: f"will be {each.offset_held}" for each in held})


NOISE_SOURCES = {
    NoiseSource.GIVEN: "that of `calibration.solve.sensor_noise_ut`",
    NoiseSource.MAP: "that of the survey's sensors, by the map",
    NoiseSource.ASSUMED: "that of `plan.noise_ut`, as the map states none",
}


def noise_note(plan: DrivePlan) -> str:
    """Return which noise is assumed of which sensors, where it is from, and how to state it."""
    names = ", ".join(each.sensor for each in plan.sensors[:10])
    more = f" and {len(plan.sensors) - 10} more" if len(plan.sensors) > 10 else ""
    source = NOISE_SOURCES[plan.noise_source]
    told = f"noise of {names}{more} is taken as {plan.noise:.3g} uT: {source}"
    if plan.noise_source is NoiseSource.GIVEN:
        return told
    return (
        f"{told}; their own is not known, and if it is larger, so are sigmas: state it with "
        "`calibration.solve.sensor_noise_ut`"
    )


def motion_table(plan: DrivePlan) -> Table:
    """Return one row per extra motion for the sensor that is determined least, the best first."""
    title = f"What an extra motion would add for {escape(plan.worst.sensor)}, by itself"
    table = plain_table(title)
    add_text(table, "motion")
    for heading in ("parameters not determined", "least determined", "its sigma"):
        table.add_column(heading)
    table.add_row("(the drive as it is)", *_worst_cells(plan.worst))
    for each in plan.motions:
        table.add_row(escape(each.motion), *_worst_cells(each.worst))
    return table


def advice(plan: DrivePlan) -> str:
    """Return the motion that helps most, as a sentence."""
    best = plan.motions[0]
    if best.worst.badness >= plan.worst.badness:
        return "no motion that was tried helps"
    change = f"{_known(plan.worst)}; with it {_known(best.worst)}"
    return f"helps {plan.worst.sensor} most: {best.motion} ({change})"


def _known(worst: Worst) -> str:
    left, parameter, sigma = _worst_cells(worst)
    unknown = f"{left} parameters not determined" if worst.undetermined else ""
    least = f"least determined: {parameter}, sigma {sigma}" if worst.parameter else ""
    return ", ".join(part for part in (unknown, least) if part)


def _worst_cells(worst: Worst) -> tuple[str, str, str]:
    if not worst.parameter:
        return str(worst.undetermined), "", ""
    factor, unit = UNITS[worst.parameter[0]]
    sigma = in_unit(sigma_alone(factor * worst.sigma), unit)
    return str(worst.undetermined), worst.parameter, sigma


def _sensor_row(sensor: SensorPlan) -> tuple[str, ...]:
    sigma = sensor.sigma
    priors = [f"from priors: {each}" for each in sensor.from_priors]
    place = " ".join(f"{value:.3f}" for value in sensor.t_lidar_mag)
    return (
        escape(sensor.sensor),
        sigmas_cell(1e3 * sigma[:3]),
        sigmas_cell(sigma[12:]),
        sigmas_cell(np.degrees(np.sqrt(np.diag(sensor.rotation_covariance)))),
        escape(". ".join([*sensor.undetermined, *priors])),
        sigmas_cell(np.array([1e3 * sensor.offset_sigma])),
        sigmas_cell(sigma[3:12].reshape(3, 3).max(axis=0)),
        place,
        f"{sensor.readings:,}",
        f"{sensor.outside_map:,}",
    )


def bag_table(report: BagReport) -> Table:
    """Return one row per topic: use, count, rate, strength, type, frame, gaps, NaN."""
    table = plain_table(escape(str(report.path)))
    add_text(table, "topic", 14)
    add_text(table, "use", 20)
    add_numbers(table, ("count", "Hz", "|B| (uT)"))
    add_text(table, "type", 14)
    add_text(table, "frame", 10)
    add_numbers(table, ("gap (s)", "clock (s)", "NaN"))
    for topic in report.topics:
        below = f"{topic.topic}: {topic.use}" in report.obstacles
        table.add_row(*_topic_row(replace(topic, use="refused: see below") if below else topic))
    return table


def _topic_row(topic: TopicReport) -> tuple[str, ...]:
    found = topic.strength
    field = "" if found is None else f"{found.low:.4g} - {found.median:.4g} - {found.high:.4g}"
    return (
        escape(topic.topic),
        escape(topic.use),
        f"{topic.count:,}",
        _number(topic.rate_hz, ".4g"),
        field,
        escape(topic.msgtype.replace("/msg/", "/")),
        escape(", ".join(topic.frames)),
        _number(topic.longest_gap_s, ".3g"),
        _number(topic.clock_offset_s, ".3g"),
        _number(topic.nan_share, ".1%"),
    )


def _number(value: float, form: str) -> str:
    return "" if np.isnan(value) else format(value, form)
