"""Names of sensors in pictures of a vehicle: none is written over another, of however many."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Annotation, Text

from l2m_gtsam.data import FloatArray, SourceFile, Trajectory
from l2m_gtsam.qa.report.figures.names import MOST_NAMES
from l2m_gtsam.qa.report.figures.vehicle import (
    SIDE,
    TOP,
    Viewpoint,
    calibration_figure,
    vehicle_figure,
)
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.verdict import Level, SensorVerdict, Verdict
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.record_files import read_metrics
from tests.support.repository import REPOSITORY


def calibration(places: FloatArray) -> CalibrationResult:
    """Return a calibration with a sensor at each place, (N, 3) in metres."""
    known = read_calibration(REPOSITORY / "tests" / "files" / "calibration.yaml")
    (one,) = known.sensors
    sensors = [
        replace(one, sensor=f"mag_{k:02d}", t_lidar_mag=place) for k, place in enumerate(places)
    ]
    return replace(known, sensors=tuple(sensors))


def labels(result: CalibrationResult, view: Viewpoint) -> tuple[list[str], FloatArray]:
    """Return what is written beside sensors and lidar, and its corners in pixels, (N, 4)."""
    sensors = tuple(SensorVerdict(each.sensor, Level.PASS, ()) for each in result.sensors)
    figure = vehicle_figure(result, Verdict(Level.PASS, (), sensors), view)
    FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    found = [
        each
        for each in figure.findobj(Annotation)
        if isinstance(each, Annotation) and each.get_text().startswith(("mag_", "lidar"))
    ]
    # without their lines
    boxes = [Text.get_window_extent(each).extents for each in found]
    return [each.get_text() for each in found], np.array(boxes)


rng = np.random.default_rng(3)
VEHICLES = {
    "one": np.array([[0.3, 0.1, 0.2]]),
    "at one place": 0.2 + rng.normal(0, 1e-3, (20, 3)),
    "close together": rng.normal([0.2, -0.1, 0.15], 0.02, (20, 3)),
    "all over": rng.uniform(-0.5, 0.5, (20, 3)),
    "on a frame": np.array(
        [(0.3 * i, 0.4 * j, 0.2 * k) for i in (-1, 1) for j in (-1, 1) for k in (0, 1)]
    ),
    "in a row": np.column_stack([np.linspace(-1, 1, 12), np.zeros(12), np.full(12, 0.1)]),
}


DRIVE = Trajectory(np.arange(3), np.tile(np.eye(3), (3, 1, 1)), np.eye(3), "map", "lidar")
PAIRS = np.array(
    [(x, s * 0.4, z + s * 0.01) for x in (-0.4, 0.4) for z in (-0.3, -0.1) for s in (-1, 1)]
)


@pytest.mark.parametrize(
    ("bags", "drives", "expected"),
    [
        ((), 1, ["drive of the lidar"]),
        (("day/a.bag", "day/$\\b$.bag"), 2, ["drive 1: a.bag", "drive 2: $\\b$.bag"]),
        (tuple(f"{k}.bag" for k in range(9)), 9, ["drives of the lidar"]),
    ],
)
def test_the_legend_names_drives(bags: tuple[str, ...], drives: int, expected: list[str]) -> None:
    result = replace(calibration(PAIRS), bags=tuple(SourceFile(each, "") for each in bags))
    picture = read_metrics(REPOSITORY / "tests" / "files" / "metrics.json").map
    legend = calibration_figure(picture, [DRIVE] * drives, result, ()).axes[0].get_legend()
    assert legend is not None
    assert [each.get_text() for each in legend.get_texts()] == expected


@pytest.mark.parametrize("overview", [False, True])
def test_sensors_that_are_close_together_have_a_name_and_a_line_each(overview: bool) -> None:
    """From the side pairs are 2 cm apart; names stay inside of the frame."""
    result = calibration(PAIRS)
    if overview:
        picture = read_metrics(REPOSITORY / "tests" / "files" / "metrics.json").map
        figure = calibration_figure(picture, [DRIVE], result, ())
    else:
        sensors = tuple(SensorVerdict(each.sensor, Level.PASS, ()) for each in result.sensors)
        figure = vehicle_figure(result, Verdict(Level.PASS, (), sensors), SIDE)
    FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    axes = figure.axes[2] if overview else figure.axes[0]
    names = [each for each in axes.texts if isinstance(each, Annotation)]
    assert {each.get_text() for each in names} == {
        "lidar",
        *(each.sensor for each in result.sensors),
    }
    frame = axes.get_window_extent().extents
    for each in names:
        assert each.arrow_patch is not None
        box = Text.get_window_extent(each).extents
        assert np.all(box[:2] >= frame[:2])
        assert np.all(box[2:] <= frame[2:])


@pytest.mark.parametrize("view", [TOP, SIDE])
@pytest.mark.parametrize("name", VEHICLES)
def test_no_name_is_written_over_another(name: str, view: Viewpoint) -> None:
    places = VEHICLES[name]
    texts, boxes = labels(calibration(places), view)
    told = 0
    for text in texts:
        lines = text.split("\n")
        assert len(lines) <= MOST_NAMES
        last = lines[-1]
        others = int(last.split()[1]) if last.startswith("and ") else 0
        told += len(lines) - bool(others) + others
    assert told == len(places) + 1
    for one, other in combinations(boxes, 2):
        # A pixel: letters have some room in their boxes.
        assert np.any((one[2:] < other[:2] + 1) | (other[2:] < one[:2] + 1)), texts
