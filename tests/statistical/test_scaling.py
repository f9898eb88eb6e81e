"""The scaling study: its exponents and ratios, and the whole of it at a tiny size."""

import io
import re
import sys
from contextlib import redirect_stdout
from mmap import mmap
from pathlib import Path
from subprocess import CompletedProcess
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.calibration.start.global_start import StartOptions
from l2m_gtsam.maps.training import training_set
from l2m_gtsam.studies.methods import numeric_least_squares
from l2m_gtsam.studies.scaling import workers
from l2m_gtsam.studies.scaling.measurements import (
    Measurement,
    Quantity,
    ScalingOptions,
    ScalingTable,
    TimedTask,
    exponent,
    scaling_table,
)
from l2m_gtsam.studies.scaling.study import SCALING
from l2m_gtsam.studies.scaling.tasks import middle, taken
from l2m_gtsam.studies.scaling.workers import Stint, measured_workers, rate
from tests.support.inline_study import run_inline
from tests.support.one_process import computed_here
from tests.worlds.exact import dipole_world, random_sensors
from tests.worlds.exact import drive as simulated
from tests.worlds.study_sites import one_row_site

MIB = 2**20
FRESH = 64 * MIB
# Calibrations on a harmonic map take longer; others test them.
SITE = one_row_site(0.1, "bilinear")
TINY = ScalingOptions(
    readings=(40, 80),
    numeric_readings=40,
    sensors=(1,),
    each=40,
    survey=(150, 300),
    dense=(50, 100),
    workers=(1,),
    calibrations=2,
    rounds=1,
    rate=4.0,
    site=SITE,
    small_site=SITE,
    search=StartOptions(search_radius=0.7, poses=20, basins=2),
)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scaling")


def run_here(program: list[str], **given: Any) -> CompletedProcess[str]:
    """Run one of our programs in this process, which spares seconds of imports."""
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed):
        patch.setattr(sys, "stdin", io.StringIO(given["input"]))
        exec(program[-1], {})  # noqa: S102 - our own program
    return CompletedProcess(program, 0, printed.getvalue(), "")


@pytest.fixture(scope="module")
def table(out: Path) -> ScalingTable:
    """The study without processes of their own; the program of workers runs here, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workers, "subprocess", SimpleNamespace(run=run_here))
        patch.setattr(workers, "computed", computed_here)
        return run_inline(SCALING, TINY, out)


@pytest.mark.study
def test_workers_are_timed_in_a_program_of_its_own() -> None:
    alone, started = measured_workers(TINY, 1)
    assert 0 < alone.seconds < started.seconds


def test_every_size_is_timed(table: ScalingTable) -> None:
    found = {(c.part, c.way): [each.size for each in c.points] for c in table.curves}
    assert found == {
        (Quantity.READINGS, TimedTask.POINT): [40, 80],
        (Quantity.READINGS, TimedTask.FULL): [40, 80],
        (Quantity.READINGS, TimedTask.NUMERIC): [40],
        (Quantity.SENSORS, TimedTask.POINT): [1],
        (Quantity.SENSORS, TimedTask.FULL): [1],
        (Quantity.SENSORS, TimedTask.NUMERIC): [1],
        (Quantity.SURVEY, TimedTask.HARMONIC): [150, 300],
        (Quantity.SURVEY, TimedTask.SLIDING): [150, 300],
        (Quantity.SURVEY, TimedTask.DENSE): [50, 100],
        (Quantity.WORKERS, TimedTask.BATCH): [1],
        (Quantity.WORKERS, TimedTask.STARTED): [1],
    }
    assert all(point.seconds > 0 for curve in table.curves for point in curve.points)


def test_the_start_of_workers_takes_time(table: ScalingTable) -> None:
    alone, started = (c.points[0] for c in table.curves if c.part is Quantity.WORKERS)
    assert started.seconds > alone.seconds


def test_page_and_figure_are_made_of_the_file(out: Path, table: ScalingTable) -> None:
    page = (out / "scaling.md").read_text(encoding="utf-8")
    assert SCALING.page(table) in page
    for name in re.findall(r"!\[.*\]\((.*)\)", page):
        assert (out / name).stat().st_size > 10_000


def points(part: Quantity, way: TimedTask, seconds: dict[int, float]) -> list[Measurement]:
    return [Measurement(part, way, size, each) for size, each in seconds.items()]


@given(power=st.floats(-2.0, 4.0), unit=st.floats(1e-4, 1e3))
def test_the_exponent_is_that_of_a_power(power: float, unit: float) -> None:
    measured = points(
        Quantity.SURVEY, TimedTask.DENSE, {n: unit * n**power for n in (10, 100, 1000)}
    )
    # Logarithms up to 30 are rounded to 1e-15 of themselves.
    assert exponent(tuple(measured)) == pytest.approx(power, abs=1e-9)


def test_the_exponent_is_that_of_the_largest_sizes() -> None:
    seconds = {1: 5.0, 2: 5.0, 4: 4.0, 8: 8.0, 16: 16.0}
    assert exponent(tuple(points(Quantity.SURVEY, TimedTask.DENSE, seconds))) == pytest.approx(1.0)


def test_one_size_has_no_exponent() -> None:
    assert exponent(tuple(points(Quantity.SURVEY, TimedTask.DENSE, {5: 1.0}))) is None


def test_ratios_are_those_at_the_largest_size_of_both() -> None:
    measured = [
        *points(Quantity.READINGS, TimedTask.POINT, {10: 1.0, 20: 2.0, 40: 4.0}),
        *points(Quantity.READINGS, TimedTask.NUMERIC, {10: 3.0, 20: 12.0}),
        *points(Quantity.SENSORS, TimedTask.POINT, {1: 1.0}),
    ]
    (found,) = scaling_table(ScalingOptions(), measured).ratios
    assert (found.size, found.times, found.peer) == (20, 6.0, TimedTask.NUMERIC)


def test_speeds_are_relative_to_the_fewest_workers() -> None:
    measured = [
        *points(Quantity.WORKERS, TimedTask.BATCH, {1: 10.0, 2: 5.0}),
        *points(Quantity.WORKERS, TimedTask.STARTED, {1: 12.0, 2: 8.0}),
    ]
    one, two = scaling_table(ScalingOptions(), measured).speeds
    assert (one.times, two.workers, two.times, two.started) == (1.0, 2, 2.0, 1.5)


def test_a_page_of_a_part_has_no_empty_sections() -> None:
    table = scaling_table(ScalingOptions(), points(Quantity.SURVEY, TimedTask.DENSE, {10: 1.0}))
    assert re.findall(r"^## (.*)", SCALING.page(table), flags=re.M) == ["Size of the map"]


def test_the_first_calibration_of_a_process_does_not_count() -> None:
    # One process takes 9 s for the first and 1 s for each other, another has only one of 2 s.
    stints = [Stint(1, 0.0, 9.0), Stint(1, 9.0, 10.0), Stint(1, 10.0, 11.0), Stint(2, 0.0, 2.0)]
    assert rate(stints) == pytest.approx(1.0 + 0.5)


def test_the_middle_of_a_survey_grows_about_its_middle() -> None:
    points_ = np.random.default_rng(3).uniform(0.0, 10.0, (200, 3))
    survey = training_set(points_, np.zeros((200, 3)))
    small, large = middle(survey, 20), middle(survey, 80)
    assert (len(small), len(large)) == (20, 80)
    assert {tuple(p) for p in small.points} <= {tuple(p) for p in large.points}


def test_memory_of_work_is_seen() -> None:
    filling = bytes(FRESH)
    took = taken(lambda: mmap(-1, FRESH).write(filling), rounds=1, long=1.0)
    if took.peak_mib is None:
        pytest.skip("this system does not tell the peak of a process' memory")
    # Fresh pages, as an array may stand on some that earlier tests left; counters lag by some.
    assert took.peak_mib == pytest.approx(FRESH / MIB, abs=4)


def test_the_peer_finds_the_truth_of_two_sensors_on_an_exact_map() -> None:
    world, sensors = dipole_world(0), random_sensors(0, 2)
    readings = simulated(1, sensors, world, count=150)
    start = np.array([sensor.t_lidar_mag for sensor in sensors]) + 0.02
    found = numeric_least_squares(readings, lambda x: world.field_and_gradient(x)[0], start)
    truth = [s.vector() for s in sensors]
    # It stops when steps or gains are a hundred millionth; numeric derivatives are off by as much.
    np.testing.assert_allclose(found, truth, rtol=0, atol=1e-4)
