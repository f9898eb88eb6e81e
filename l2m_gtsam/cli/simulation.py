"""``l2m simulate``, ``demo`` and ``study``: worlds whose truth is known."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from l2m_gtsam.cli.terminal import (
    OutOption,
    SchedulerOption,
    WideOption,
    WorkersOption,
    print_table,
    print_verdict,
    say,
    shown_progress,
)

if TYPE_CHECKING:
    from l2m_gtsam.simulate.scenario import ScenarioOptions

ScenarioOption = Annotated[
    Path | None, typer.Option("--options", help="YAML with the options of the simulation.")
]
SeedOption = Annotated[
    int | None,
    typer.Option(min=0, help="Of world, drives and sensors, instead of that in --options (1)."),
]


def simulate(
    out: OutOption,
    options: ScenarioOption = None,
    seed: SeedOption = None,
    kind: Annotated[
        list[str] | None, typer.Option(help="ros1, sqlite3 or mcap; all three if not given.")
    ] = None,
) -> None:
    """Simulate a warehouse, a mapping drive and a calibration drive, and write them as bags."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.simulation import simulate_bags
        from l2m_gtsam.errors import ConfigError
        from l2m_gtsam.simulate.bag_writer import BagKind

        known = [each.value for each in BagKind]
        if unknown := [each for each in kind or [] if each not in known]:
            msg = f"--kind: unknown bag kind {unknown[0]!r}; accepted: {', '.join(known)}"
            raise ConfigError(msg)
        wanted = _scenario(options, seed)
        simulate_bags(out, wanted, [BagKind(k) for k in kind or known], progress)
    say(f"bags, suite.yaml, structure.ply and truth.yaml are in {out}")


def demo(
    out: OutOption = Path("demo_out"),
    options: ScenarioOption = None,
    seed: SeedOption = None,
    wide: WideOption = False,
) -> None:
    """Simulate, map and calibrate a warehouse, and compare with the truth."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.drives import OVERVIEW_FILE, calibrate_bags
        from l2m_gtsam.batch.maps import build_map_file
        from l2m_gtsam.batch.reports import REPORT_FILE, calibration_results, report_calibration
        from l2m_gtsam.batch.simulation import STRUCTURE_FILE, SUITE_FILE, bag_name, simulate_bags
        from l2m_gtsam.cli.tables.calibration import consistency_note, truth_table
        from l2m_gtsam.config import Config
        from l2m_gtsam.simulate.bag_writer import BagKind
        from l2m_gtsam.storage.files import ensure_folder

        wanted, chosen, map_path = _scenario(options, seed), Config(), out / "map.npz"
        ensure_folder(out)
        truth = simulate_bags(out, wanted, [BagKind.MCAP], progress).truth
        mapping, drive = (out / bag_name(each, BagKind.MCAP) for each in ("mapping", "calibration"))
        cloud = str(out / STRUCTURE_FILE)
        build_map_file([mapping], map_path, chosen, out / SUITE_FILE, progress, cloud)
        with calibration_results(out) as stage:
            found = calibrate_bags([drive], map_path, chosen, stage, progress, truth)
            verdict = report_calibration(stage, found, chosen.qa, progress)
    print_table(truth_table(found.result, truth), wide)
    say(consistency_note(found.result, truth))
    print_verdict(verdict)
    picture, page = out / OVERVIEW_FILE, out / REPORT_FILE
    say(f"picture: {picture}; report: {page}; everything else is in {out}")


def _scenario(options: Path | None, seed: int | None) -> "ScenarioOptions":
    """Return what is simulated: the default, or that of a file; a seed replaces that of both."""
    from l2m_gtsam.config import load_options
    from l2m_gtsam.simulate.scenario import ScenarioOptions

    wanted = ScenarioOptions() if options is None else load_options(options, ScenarioOptions)
    return wanted if seed is None else wanted.model_copy(update={"seed": seed})


def study(
    name: Annotated[str, typer.Argument(metavar="STUDY", help="Its name; see docs/studies.")],
    out: OutOption,
    options: Annotated[
        Path | None, typer.Option("--options", help="YAML with the study's options.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Of everything random, instead of that in --options.")
    ] = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
) -> None:
    """Run a study: one of those in docs/studies, such as table1, honesty or changes.

    Started again with the same --out it goes on where it was stopped.
    """
    with shown_progress() as progress:
        from l2m_gtsam.config import load_options
        from l2m_gtsam.errors import ConfigError
        from l2m_gtsam.parallel.cluster import ClusterOptions
        from l2m_gtsam.studies.registry import STUDIES
        from l2m_gtsam.studies.run import run_study

        if name not in STUDIES:
            raise ConfigError(f"study {name!r} is not known; accepted: {', '.join(STUDIES)}")
        chosen = STUDIES[name]
        wanted = chosen.options() if options is None else load_options(options, chosen.options)
        if seed is not None:
            wanted = wanted.model_copy(update={"seed": seed})
        cluster = ClusterOptions(
            scheduler=scheduler, **({} if workers is None else {"workers": workers})
        )
        command = shlex.join(
            ["l2m", "study", name, *(["--options", str(options)] if options else [])]
        )
        made = run_study(chosen, wanted, out, cluster, progress, f"{command} --seed {wanted.seed}")
    say(*chosen.page(made.summary).splitlines())
    say(f"written: {out / f'{name}.md'}")
