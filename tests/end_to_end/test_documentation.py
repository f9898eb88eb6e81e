"""The documentation: every block of every page runs, every message is a real one."""

import ast
import json
import re
import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import l2m_gtsam
from l2m_gtsam.api.results import JudgedCalibration
from l2m_gtsam.batch.simulation import simulate_bags
from l2m_gtsam.config import load_options
from l2m_gtsam.progress import silent
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.simulate.bag_writer import BagKind
from l2m_gtsam.simulate.scenario import ScenarioOptions
from tests.drives.slam import calibrated
from tests.support.computed_once import computed_once
from tests.support.map_files import copy_map
from tests.support.pages import blocks, run_page, run_python, words
from tests.support.repository import REPOSITORY
from tests.worlds.exact import dipole_world, random_sensors

DOCS = REPOSITORY / "docs"
PAGES = [REPOSITORY / "README.md", *sorted(DOCS.rglob("*.md"))]
# How many blocks of a page are not run; each says why.
NOT_RUN = {
    "README.md": 2,
    "docs/index.md": 2,
    "docs/tutorial.md": 1,
    "docs/fleet.md": 1,
    "docs/lidar.md": 2,
    "docs/own-bag.md": 4,
    "docs/report.md": 1,
    "docs/slam.md": 4,
    "docs/studies/README.md": 2,
}
MESSAGE = re.compile(r"\*\*`` (.+?) ``\*\*", re.DOTALL)
LEAST_QUOTED = 60  # messages of the page; fewer would be a test that has lost its object


def named(page: Path) -> str:
    return page.relative_to(REPOSITORY).as_posix()


@pytest.fixture(scope="module", autouse=True)
def _maps_and_calibrations_are_computed_once() -> Iterator[None]:
    """Several pages build the same map and calibrate the same drive: the first does it for all."""
    with computed_once():
        yield


@pytest.fixture(scope="module")
def tutorial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the tutorial has run, once for all pages."""
    folder = tmp_path_factory.mktemp("tutorial")
    run_page(DOCS / "tutorial.md", folder)
    return folder


@pytest.fixture
def workplace(tutorial: Path, without_pages: None, texts_read_once: None, tmp_path: Path) -> Path:
    """A folder with what the other pages take for granted, under the names that they use.

    Reports are drawn by the tutorial alone.
    """
    sim = tutorial / "sim"
    for source, name in (
        (sim / "calibration_ros1.bag", "drive.bag"),
        (sim / "mapping_ros1.bag", "mapping.bag"),
        (sim / "suite.yaml", "suite.yaml"),
        (sim / "structure.ply", "cloud.ply"),
        (tutorial / "result" / "calibration.yaml", "calibration.yaml"),
        (tutorial / "result" / "calibration.yaml", "old.yaml"),
    ):
        shutil.copy(source, tmp_path / name)
    copy_map(tutorial / "map.npz", tmp_path / "map.npz")
    robot = '<robot name="r"><link name="velodyne"/></robot>'
    (tmp_path / "robot.urdf").write_text(robot)
    return tmp_path


def test_the_tutorial(tutorial: Path) -> None:
    """Its blocks ran when the fixture was made; what it promises is there."""
    for name in ("map.npz", "result/report.html", "corrected.bag", "magnetometers.launch.py"):
        assert (tutorial / name).is_file()


# Pages that run in tests of their own: all of their blocks, on smaller inputs.
ELSEWHERE = {"tutorial.md": "the fixture above", "validate.md": "test_validate_command.py"}


@pytest.mark.parametrize("page", [p for p in PAGES if p.name not in ELSEWHERE], ids=named)
def test_every_block_of_a_page(page: Path, workplace: Path) -> None:
    if page.name == "README.md" and page.parent == REPOSITORY:
        more_readings(workplace)
    run_page(page, workplace)


def test_the_notebook(workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its cells run one after the other, and what they show can be shown."""
    monkeypatch.chdir(workplace)
    names: dict[str, object] = {}
    notebook = json.loads((DOCS / "python.ipynb").read_text(encoding="utf-8"))
    cells = ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"]
    for number, cell in enumerate(cells):
        *body, last = ast.parse(cell).body
        shown = isinstance(last, ast.Expr)
        rest = ast.Module(body if shown else [*body, last], [])
        exec(compile(rest, f"cell {number}", "exec"), names)  # noqa: S102 - our own
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "", "eval"), names)  # noqa: S307
            assert getattr(value, "_repr_html_", value.__repr__)()
    found = names["found"]
    assert isinstance(found, JudgedCalibration)
    assert found.verdict.level is Level.PASS
    assert all(not cell["outputs"] for cell in notebook["cells"] if cell["cell_type"] == "code")


def more_readings(folder: Path) -> None:
    """Write another survey of the hall of the tutorial as `more.bag`."""
    path = folder / "again"
    (yaml,) = (b for b in blocks(DOCS / "tutorial.md") if b.title == "hall.yaml")
    options = folder / "hall.yaml"
    options.write_text(yaml.text)
    wanted = load_options(options, ScenarioOptions).model_copy(update={"survey_seed": 2})
    simulate_bags(path, wanted, [BagKind.ROS1], silent)
    shutil.move(path / "mapping_ros1.bag", folder / "more.bag")


def test_blocks_that_do_not_run_are_counted() -> None:
    counts = {named(page): sum(bool(b.not_run) for b in blocks(page)) for page in PAGES}
    assert {page: count for page, count in counts.items() if count} == NOT_RUN


@cache
def said_by_the_program() -> list[str]:
    """Return every string of the program but docstrings, with … where something is put in."""
    found = []
    for path in sorted((REPOSITORY / "l2m_gtsam").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr):
                parts = (n.value if isinstance(n, ast.Constant) else "…" for n in node.values)
                found.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found += [node.value] if id(node) not in docs else []
    return [" ".join(text.split()) for text in found]


def test_messages_are_quoted_as_they_are_raised() -> None:
    """Their fixed words stand in one string of the program, in the order of the page."""
    page = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    said, quoted = said_by_the_program(), MESSAGE.findall(page)
    assert len(quoted) >= LEAST_QUOTED
    strange = [each for each in quoted if not raised(each, said)]
    assert not strange, "\n".join(strange)


def raised(message: str, said: list[str]) -> bool:
    """Whether one of the strings of the program has the words of a message."""
    parts = fixed(message)
    return any(fits(parts, text) for text in said)


def fixed(message: str) -> list[str]:
    """Return the parts of a message that are words: what stands between its …."""
    parts = (part.strip() for part in " ".join(message.split()).split("…"))
    return [part for part in parts if words(part)]


def fits(parts: list[str], text: str) -> bool:
    """Whether parts of a message stand in a text, one after the other."""
    at = 0
    for part in parts:
        found = text.find(part, at)
        if found < 0:
            return False
        at = found + len(part)
    return bool(parts)


def test_a_message_that_nobody_raises_is_noticed() -> None:
    said = said_by_the_program()
    assert not raised("the map of … is upside down", said)


def test_the_example_of_a_vehicle_has_all_that_it_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But for its files and messages."""
    (block,) = [each for each in blocks(DOCS / "slam.md") if "OnlineSlam(" in each.text]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(l2m_gtsam, "load_map", lambda _: dipole_world(1))
    monkeypatch.setattr(l2m_gtsam, "read_calibration", lambda _: calibrated(random_sensors(1, 2)))
    message = {"stamp_ns": 10**18, "field_ut": np.ones(3), "R": np.eye(3), "t": np.zeros(3)}
    run_python(block, message)
    assert (tmp_path / "state.npz").is_file()
