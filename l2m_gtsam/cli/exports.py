"""``l2m export`` and ``l2m apply``: a calibration for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from l2m_gtsam.cli.terminal import shown_progress, warn
from l2m_gtsam.errors import ConfigError

LidarFrameOption = Annotated[
    str, typer.Option("--lidar-frame", help="Name of the LiDAR's frame (or link) there.")
]


def register(app: typer.Typer) -> None:
    """Add the commands of this module to the command line."""
    app.command()(export)
    app.command()(apply)


def export(
    calibration: Annotated[
        Path, typer.Argument(metavar="CALIBRATION", help="calibration.yaml of `l2m calibrate`.")
    ],
    format_name: Annotated[
        str,
        typer.Option("--format", help="ros2-launch, urdf, kalibr, json or bias-scale."),
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
) -> None:
    """Write a calibration for another program: tf, URDF, Kalibr, JSON, offsets and scales."""
    from l2m_gtsam.batch.exports import Names, export_calibration

    names = Names(lidar_frame, dict(_named(text) for text in frame or []))
    warn(export_calibration(calibration, format_name, out, names, into))
    typer.echo(f"written: {out}")


def apply(
    bag: Annotated[
        Path, typer.Argument(metavar="BAG", help="ROS1 .bag, ROS2 folder, .db3 or .mcap.")
    ],
    calibration: Annotated[
        Path, typer.Option("--calibration", help="calibration.yaml of `l2m calibrate`.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Bag to write, of the same kind.")],
    config: Annotated[
        Path | None,
        typer.Option("--config", help="YAML configuration; that of the calibration if not given."),
    ] = None,
    lidar_frame: LidarFrameOption = "lidar",
    replace: Annotated[
        bool, typer.Option("--replace", help="Leave the topics that are corrected out.")
    ] = False,
) -> None:
    """Copy a bag and add the corrected readings, in the axes of the LiDAR, as TOPIC/calibrated."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.exports import Application, apply_calibration

        wanted = Application(bag, calibration, out, config, lidar_frame, replace)
        applied = apply_calibration(wanted, progress)
    warn(applied.notes)
    for sensor, topic in applied.topics.items():
        typer.echo(f"{sensor}: {topic}")
    typer.echo(f"written: {out}")


def _named(text: str) -> tuple[str, str]:
    """Return a sensor and its frame."""
    sensor, equals, name = text.rpartition("=")
    if not (sensor and equals):
        raise ConfigError(f"--frame: {text!r} is not understood; accepted: SENSOR=NAME")
    return sensor, name
