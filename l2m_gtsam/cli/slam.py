"""``l2m slam``: where the vehicle was."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from l2m_gtsam.cli.terminal import (
    LOGS,
    OutOption,
    PosesOption,
    PoseTimesOption,
    SensorsOption,
    StrictOption,
    WideOption,
    end_with,
    print_table,
    print_verdict,
    say,
    say_written,
    shown_progress,
)
from l2m_gtsam.errors import ConfigError

if TYPE_CHECKING:
    from l2m_gtsam.batch.online_slam import OnlineOutcome
    from l2m_gtsam.batch.slam import SlamOutcome


def slam(
    bag: Annotated[Path, typer.Argument(metavar="BAG", help=f"Drive with odometry: {LOGS}.")],
    calibration: SensorsOption,
    out: OutOption,
    map_path: Annotated[
        Path | None,
        typer.Option("--map", help="Map file; without one, the field is estimated with the poses."),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option("--truth", help="True poses of the LiDAR in the map (TUM), to compare with."),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="YAML configuration; see `slam` in it.")
    ] = None,
    online: Annotated[
        bool,
        typer.Option("--online", help="Message by message, as on a vehicle; its state is saved."),
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="With --online: go on from the state in --out.")
    ] = False,
    poses: PosesOption = None,
    times: PoseTimesOption = None,
    strict: StrictOption = False,
    wide: WideOption = False,
) -> None:
    """Localise a drive in a magnetic map, or estimate its path and the field together (SLAM)."""
    if resume and not online:
        raise ConfigError("--resume goes on with a run of --online: give both")
    with shown_progress() as progress:
        from l2m_gtsam.batch.online_slam import slam_online
        from l2m_gtsam.batch.slam import SlamInput, slam_bag
        from l2m_gtsam.config import load_config, with_poses

        chosen = with_poses(load_config(config), [bag], poses or (), times)
        given = SlamInput(bag, map_path, calibration, truth)
        if online:
            followed = slam_online(given, chosen, out, progress, resume=resume)
        else:
            done = slam_bag(given, chosen, out, progress)
    if online:
        _print_online(followed, out)
        return
    _print_off_line(done, out, wide)
    end_with(done.verdict.level, strict)


def _print_online(done: "OnlineOutcome", out: Path) -> None:
    from l2m_gtsam.cli.tables.slam import online_lines, truth_lines

    say(*online_lines(done), *truth_lines(done.truth), f"written: {out}")


def _print_off_line(done: "SlamOutcome", out: Path, wide: bool) -> None:
    from l2m_gtsam.batch.reports import SLAM_FILE
    from l2m_gtsam.cli.tables.slam import (
        drift_lines,
        gain_lines,
        scan_lines,
        slam_table,
        start_lines,
        truth_lines,
    )
    from l2m_gtsam.storage.record_files import record_id

    print_table(slam_table(done.result), wide)
    lines = (
        *start_lines(done.result.start),
        *drift_lines(done.result),
        *gain_lines(done.result.gain),
        *scan_lines(done.result.scans),
        *truth_lines(done.record.truth),
    )
    say(*lines)
    print_verdict(done.verdict)
    say_written([out], record_id(out / SLAM_FILE))
