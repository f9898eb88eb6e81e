"""The command line: ``l2m``. Parsing and printing only; the work is done in ``batch``.

Heavy modules are imported inside the commands, so that ``--help`` answers at once, and below the
first bar, so that it is seen while they load.
"""

import ctypes
import gc
import os
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from l2m_gtsam.cli.calibration import batch, calibrate, config, inspect, plan
from l2m_gtsam.cli.endings import Stopped, flush_output, last_line, stopped_by_signals
from l2m_gtsam.cli.maps import map_app
from l2m_gtsam.cli.results import apply, export, report, validate
from l2m_gtsam.cli.simulation import demo, simulate, study
from l2m_gtsam.cli.slam import slam
from l2m_gtsam.cli.terminal import shown_notices

ORDER = (
    *("inspect", "config", "map", "plan", "calibrate", "report", "validate", "export", "apply"),
    *("batch", "slam", "demo", "simulate", "study"),
)
"""Of use."""


class InOrder(TyperGroup):
    """The commands in the order of use."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return their names."""
        names = super().list_commands(ctx)
        return sorted(names, key=ORDER.index)


app = typer.Typer(
    cls=InOrder,
    name="l2m",
    help="Calibrate magnetometers against a LiDAR from one drive through a mapped field.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.add_typer(map_app, name="map")
for _command in (
    study,
    batch,
    export,
    apply,
    report,
    validate,
    slam,
    inspect,
    config,
    simulate,
    calibrate,
    plan,
    demo,
):
    app.command()(_command)


DEBUG = "--debug"

ALLOCATED = 100_000  # objects, after which Python looks for cycles among them: 700 by default
# Parameters of glibc's mallopt, and sizes in bytes.
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
KEPT, MAPPED = (1 << 31) - 1, 1 << 30


def main() -> None:
    """Run the command line; whatever ends it is one last line and an exit code.

    2 is what a user can mend, 70 a fault of this program, 128 and the number of a signal a stop.
    """
    # Blocks of a few hundred readings are too small for threads, which then only wait for each
    # other; has to be set before numpy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _suit_large_arrays()
    arguments = [argument for argument in sys.argv[1:] if argument != DEBUG]
    try:
        with stopped_by_signals(), shown_notices():
            _run(arguments)
    except (Stopped, Exception) as error:
        if DEBUG in sys.argv[1:]:
            raise
        sys.exit(last_line(error))


def _suit_large_arrays() -> None:
    """Have memory managed for few large arrays in place of many small objects.

    glibc gives each array of megabytes back to the system, which clears every page that it hands
    out again: a tenth of a calibration's time. Looking for cycles took a twentieth.
    """
    gc.set_threshold(ALLOCATED)
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library
        return
    mallopt(TRIM_THRESHOLD, KEPT)
    mallopt(MMAP_THRESHOLD, MAPPED)


def _run(arguments: list[str]) -> None:
    """Run a command; what it printed has arrived when it returns or ends."""
    try:
        app(arguments)
    finally:
        flush_output()


def _version(wanted: bool) -> None:
    """Print the version and end."""
    if wanted:
        from importlib.metadata import version

        typer.echo(f"l2m {version('l2m-gtsam')}")
        raise typer.Exit


@app.callback()
def options(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error (at any place).")
    ] = False,
) -> None:
    """Calibrate magnetometers against a LiDAR from one drive through a mapped field."""
