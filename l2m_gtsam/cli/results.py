"""``l2m report``, ``validate``, ``export`` and ``apply``: what is done with results."""

from pathlib import Path
from typing import Annotated

import typer

from l2m_gtsam.cli.terminal import (
    LOGS,
    CalibrationOption,
    PosesOption,
    PoseTimesOption,
    StrictOption,
    WideOption,
    end_with,
    print_table,
    print_verdict,
    say,
    say_written,
    shown_progress,
    warn,
)
from l2m_gtsam.errors import ConfigError

LidarFrameOption = Annotated[
    str, typer.Option("--lidar-frame", help="Name of the LiDAR's frame (or link) there.")
]

DespiteOption = Annotated[
    bool,
    typer.Option(
        "--despite-verdict",
        help="Use a calibration that was judged FAIL all the same; the verdict is written, too.",
    ),
]


def report(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Folder that `l2m calibrate` or `l2m slam` wrote to."),
    ],
    config: Annotated[
        Path | None,
        typer.Option(
            "--config", help="YAML configuration whose `qa` has the thresholds of the verdict."
        ),
    ] = None,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Write report.pdf, too: needs Chromium, Chrome or Edge.")
    ] = False,
) -> None:
    """Write report.html: verdict, reasons, pictures; needs no bag and no map."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.reports import PDF_FILE, REPORT_FILE, report_folder

        reported = report_folder(folder, config, progress, pdf=pdf)
    print_verdict(reported.judgement.verdict)
    warn(reported.judgement.before())
    written = [folder / REPORT_FILE, *([folder / PDF_FILE] if pdf else [])]
    say_written(written, reported.report_id)


def validate(
    calibration: CalibrationOption,
    bag: Annotated[
        Path | None, typer.Argument(metavar="[BAG]", help=f"Another drive: {LOGS}.")
    ] = None,
    map_path: Annotated[
        Path | None, typer.Option("--map", help="Map file of the place of the drive.")
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(help="An older calibration.yaml: what has changed since? Needs no BAG."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", help="YAML configuration; that of the calibration if absent."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for validation.json and validation.html.")
    ] = None,
    poses: PosesOption = None,
    times: PoseTimesOption = None,
    strict: StrictOption = False,
    wide: WideOption = False,
) -> None:
    """Test whether a calibration is still valid: on another drive, or against an older one.

    Readings are predicted from poses, map and calibration, with the uncertainty of all three.
    """
    with shown_progress() as progress:
        from l2m_gtsam.batch.validation import (
            PAGE_FILE,
            VALIDATION_FILE,
            ValidationRequest,
            validate_calibration,
        )
        from l2m_gtsam.cli.tables.validation import change_table, validation_table
        from l2m_gtsam.records.verdict import Level
        from l2m_gtsam.storage.record_files import record_id

        asked = ValidationRequest(
            calibration, bag, map_path, compare, config, out, tuple(poses or ()), times
        )
        found = validate_calibration(asked, progress)
    if found.drive is not None:
        print_table(validation_table(found.drive, found.verdict), wide)
    if found.comparison is not None:
        print_table(change_table(found.comparison), wide)
    print_verdict(found.verdict, Level.PASS)
    if out is not None:
        written = [out / VALIDATION_FILE, out / PAGE_FILE]
        say_written(written, record_id(out / VALIDATION_FILE))
    end_with(found.verdict.level, strict)


def export(
    calibration: Annotated[
        Path, typer.Argument(metavar="CALIBRATION", help="calibration.yaml of `l2m calibrate`.")
    ],
    format_name: Annotated[
        str,
        typer.Option(
            "--format", help="ros2-launch, urdf, kalibr, json, bias-scale, px4 or ardupilot."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="File to write.")],
    lidar_frame: LidarFrameOption = "lidar",
    frame: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SENSOR=NAME",
            help="Name of a sensor's frame, the sensor's own if not given; may be repeated.",
        ),
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option(help="URDF of a robot that the sensors are put into; --out gets the copy."),
    ] = None,
    despite_verdict: DespiteOption = False,
) -> None:
    """Write a calibration for another program: tf, URDF, Kalibr, JSON, autopilots, scales."""
    from l2m_gtsam.batch.exports import Names, export_calibration

    names = Names(lidar_frame, dict(_named(text) for text in frame or []))
    notes = export_calibration(
        calibration, format_name, out, names, into, despite_verdict=despite_verdict
    )
    warn(notes)
    say(f"written: {out}")


def apply(
    bag: Annotated[
        Path, typer.Argument(metavar="BAG", help="ROS1 .bag, ROS2 folder, .db3 or .mcap.")
    ],
    calibration: CalibrationOption,
    out: Annotated[Path, typer.Option("--out", help="Bag to write, of the same kind.")],
    config: Annotated[
        Path | None,
        typer.Option("--config", help="YAML configuration; that of the calibration if not given."),
    ] = None,
    lidar_frame: LidarFrameOption = "lidar",
    replace: Annotated[
        bool, typer.Option("--replace", help="Leave the topics that are corrected out.")
    ] = False,
    despite_verdict: DespiteOption = False,
) -> None:
    """Copy a bag and add the corrected readings, in the axes of the LiDAR, as TOPIC/calibrated."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.exports import Application, apply_calibration

        wanted = Application(bag, calibration, out, config, lidar_frame, replace, despite_verdict)
        applied = apply_calibration(wanted, progress)
    warn(applied.notes)
    for sensor, topic in applied.topics.items():
        say(f"{sensor}: {topic}")
    say(f"written: {out}")


def _named(text: str) -> tuple[str, str]:
    """Return a sensor and its frame."""
    sensor, equals, name = text.rpartition("=")
    if not (sensor and equals):
        raise ConfigError(f"--frame: {text!r} is not understood; accepted: SENSOR=NAME")
    return sensor, name
