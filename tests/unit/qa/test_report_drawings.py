"""Figures of a sensor: few elements, small files, and points where they belong."""

import re
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
import pytest

from l2m_gtsam.qa.report import hover
from l2m_gtsam.qa.report.drawing import (
    Drawing,
    LegendEntry,
    Panel,
    Rectangle,
    Stroke,
    legend,
    nice,
    numbers,
    spread,
)
from l2m_gtsam.qa.report.figures.map import residual_figure
from l2m_gtsam.qa.report.figures.readings import curves_figure, residuals_figure
from l2m_gtsam.qa.report.figures.statistics import chi_square_figure, sigmas_figure
from l2m_gtsam.qa.report.svg import VARIABLES, X, as_svg, new_figure
from l2m_gtsam.records.metrics import Normalised, Series

READINGS = 500
MOST_ELEMENTS = 160  # axes with numbers, and a path for each layer or colour
MOST_BYTES = 72_000  # of which 64 values under the pointer have 10,000
HOSTILE = "</svg><script>alert(1)</script>"


def series(count: int = READINGS, rejected: int = 3) -> Series:
    rng = np.random.default_rng(1)
    rows = [tuple(map(tuple, np.round(rng.normal(size=(count, 3)), 3).tolist())) for _ in range(5)]
    return Series(
        seconds=tuple(np.linspace(0, 100, count).tolist()),
        before=rows[0],
        after=rows[1],
        map=rows[2],
        residual=rows[3],
        normalised=rows[3],
        place=rows[4],
        rejected=tuple(k < rejected for k in range(count)),
        drive=None,
    )


def figures(told: Series) -> dict[str, Drawing]:
    edges = tuple(np.linspace(0, 16, 25).tolist())
    return {
        "curves": curves_figure(told),
        "residuals": residuals_figure(told),
        "place": residual_figure(told),
        "chi2": chi_square_figure(Normalised((1, 1, 1), edges, (3,) * 24, 0.05)),
        "sigmas": sigmas_figure((1.0,) * 15, (0.2,) * 14 + (float("nan"),), "sigmas"),
    }


def elements(svg: str) -> int:
    return len(re.findall(r"<(?:text|path)\b", svg))


@pytest.mark.parametrize("kind", figures(series()))
def test_a_figure_is_small_whatever_it_shows(kind: str) -> None:
    """A path for all points alike: ten times the readings are no more elements."""
    few, many = (figures(series(count))[kind] for count in (50, READINGS))
    text = as_svg(many, "a", "what it shows")
    assert len(text) < MOST_BYTES
    counts = [elements(as_svg(each, "a", "b")) for each in (few, many)]
    assert counts[1] < MOST_ELEMENTS
    assert counts[1] < counts[0] + 60
    assert not set(VARIABLES) & set(re.findall("#[0-9a-f]{6}", text))


@pytest.mark.parametrize("rejected", [0, 60])
def test_all_is_inside_and_finite(rejected: int) -> None:
    for figure in figures(series(60, rejected)).values():
        text = as_svg(figure, "a", "b")
        assert "nan" not in text
        assert "inf" not in text
        _, _, width, height = map(float, text.split('viewBox="')[1].split('"')[0].split())
        for x, y in re.findall(r'<text x="([-\d.]+)" y="([-\d.]+)"', text):
            assert 0 <= float(x) <= width
            assert 0 <= float(y) <= height


def test_points_stand_where_they_belong() -> None:
    panel = Panel(Rectangle(10, 20, 100, 50), (0.0, 10.0), (-1.0, 1.0))
    panel.line(np.array([0.0, 5.0, np.nan, 10.0]), np.array([-1.0, 0.0, 0.0, 1.0]), Stroke(X))
    panel.dots(np.array([5.0, 11.0]), np.array([0.0, 0.0]), 2.0, X, 1.0)
    line, dots = panel.parts
    assert 'd="M10.0 70.0L60.0 45.0M110.0 20.0"' in line
    assert "var(--x)" in line
    assert 'd="M60.0 45.0h0"' in dots


def test_words_are_text() -> None:
    panel = Panel(Rectangle(10, 20, 100, 50), (0.0, 1.0), (0.0, 1.0))
    panel.x_axis(HOSTILE)
    panel.y_axis(HOSTILE)
    legend(panel, [LegendEntry(HOSTILE, Stroke(X))])
    figure = Drawing(2.0, (panel,))
    figure.legend_above([LegendEntry(HOSTILE, Stroke(X))])
    assert "<script" not in as_svg(figure, "a", HOSTILE)


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ((0.0, 1.0), ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]),
        ((-50.0, 50.0), ["−40", "−20", "0", "20", "40"]),
        ((0.0, 3e-6), ["0", "1e−06", "2e−06", "3e−06"]),
    ],
)
def test_numbers_at_an_axis_are_round(limits: tuple[float, float], expected: list[str]) -> None:
    assert numbers(nice(limits, 5)) == expected


def test_limits_of_nothing_and_of_one_value() -> None:
    assert spread(np.array([np.nan])) == pytest.approx((-0.05, 1.05))
    low, high = spread(np.array([3.0, 3.0]))
    assert low < 3 < high


def titles(svg: str) -> list[tuple[dict[str, float], str]]:
    """Return numbers and words of all parts that show values."""
    parts = re.findall(r"<(?:rect|circle) ([^>]*)><title>([^<]*)</title>", svg)
    return [
        ({k: float(v) for k, v in re.findall(r'(\w+)="([-\d.]+)"', numbers_)}, words)
        for numbers_, words in parts
    ]


def test_values_are_shown_where_they_are_drawn() -> None:
    """Strips join without a gap, in the order of time, and say what was read there."""
    told = series(40, rejected=2)
    svg = as_svg(residuals_figure(told), "a", "b")
    found = titles(svg)
    assert len(found) == 40
    for (own, _), (following, _) in pairwise(found):
        assert own["x"] + own["width"] == pytest.approx(following["x"], abs=0.11)  # two roundings
    for k, (_, words) in enumerate(found):
        x, y, z = told.residual[k]
        assert words.startswith(f"{told.seconds[k]:.1f} s: x {x:+.2f}, y {y:+.2f}, z {z:+.2f} µT")
        assert words.endswith("rejected") == told.rejected[k]


def test_rejected_readings_are_among_many() -> None:
    """Of thousands of readings a few have values, and every cross that there is room for."""
    told = series(3000, rejected=10)
    words = [words for _, words in titles(as_svg(residual_figure(told), "a", "b"))]
    assert sum(each.endswith("rejected") for each in words) == 10
    assert len(words) <= 2 * hover.MOST


def test_values_of_axes_are_titles() -> None:
    """Matplotlib's parts, too; names from bags stay text."""
    figure = new_figure(2.0)
    axes = figure.add_subplot()
    hover.axes_places(axes, np.array([[1.0, 2.0]]), [f'{HOSTILE}" x="'])
    hover.axes_strips(axes, np.array([0.0, 1.0]), ["first", "second & last"])
    hover.axes_image(axes, np.array([[1.0, np.nan], [2.0, 3.0]]), (0, 2, 0, 2), "µT")
    root = ElementTree.fromstring(as_svg(figure, "a", "b"))  # noqa: S314 - our own
    found = [each.text for each in root.iter("title")]
    assert found[:3] == [f'{HOSTILE}" x="', "first", "second & last"]
    assert [text.rpartition(": ")[2] for text in found[3:] if text] == [
        "1.00 µT",
        "2.00 µT",
        "3.00 µT",
    ]
