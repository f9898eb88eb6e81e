"""Twenty names that are code, markup or control characters, wherever names are shown: text."""

import ast
import csv
import io
import json
import unicodedata
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from PIL import Image
from ruamel.yaml import YAML

from l2m_gtsam.batch import fleet as batch_fleet
from l2m_gtsam.data import Trajectory
from l2m_gtsam.qa.fleet import with_outliers
from l2m_gtsam.qa.options import FleetOptions, QaOptions
from l2m_gtsam.qa.report.figures.vehicle import calibration_figure
from l2m_gtsam.qa.report.fleet_page import fleet_page
from l2m_gtsam.qa.report.localisation_page import localisation_page
from l2m_gtsam.qa.report.page import Identity
from l2m_gtsam.qa.report.svg import save_figure
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.files import folder_names, printable
from l2m_gtsam.storage.fleet_table import write_csv
from l2m_gtsam.storage.record_files import read_metrics
from l2m_gtsam.text import shown_lines
from tests.drives.bags import Entry, ros, write
from tests.drives.degenerate import eight, mounted
from tests.drives.fleet_rows import row
from tests.drives.fleets import CONFIG, PLACE, make_place
from tests.drives.fleets import write as write_drive
from tests.drives.hostile import NAMES, fleet_rows, localisation
from tests.drives.localised import record
from tests.support.command_line import Finished, ended, l2m
from tests.support.one_process import computed_here

DANGEROUS = {"script", "img", "iframe", "object", "embed", "base", "form", "meta-refresh"}
OTHERS = ("kalibr", "bias-scale", "px4", "ardupilot")  # seconds each, and of the same parts
START = 1_700_000_000_000_000_000


def is_visible(text: str) -> bool:
    """Return whether text has no control characters but ends of lines."""
    return not {each for each in text if unicodedata.category(each) in ("Cc", "Cf")} - {"\n"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, repository: Path) -> Path:
    """A calibration and its metrics, of a sensor of each name."""
    made, files = tmp_path_factory.mktemp("hostile"), repository / "tests" / "files"
    yaml = YAML(typ="safe", pure=True)
    content = yaml.load((files / "calibration.yaml").read_text())
    ((old, known),) = content["sensors"].items()
    content["sensors"] = dict.fromkeys(NAMES, known)
    content["doubts"] = [f"{name} is in doubt" for name in NAMES]
    content["bag"]["path"] = content["map"]["path"] = NAMES[1]
    with (made / "calibration.yaml").open("w") as into:
        yaml.dump(json.loads(json.dumps(content)), into)
    metrics = json.loads((files / "metrics.json").read_text())
    (one,) = metrics["metrics"]["sensors"]
    assert one["sensor"] == old
    metrics["metrics"]["sensors"] = [{**one, "sensor": name} for name in NAMES]
    (made / "metrics.json").write_text(json.dumps(metrics))
    return made


def check_terminal(run: Finished) -> None:
    assert run.code in (0, 1, 2, 3), run
    for text in (run.out, run.err):
        assert is_visible(text), repr(text)
        assert "\nl2m: all is well" not in text
    assert "Traceback" not in run.err


class Page(HTMLParser):
    """The elements of a page, their attributes and text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def check_page(html: str, plain: str) -> None:
    """What could run is what is in the same page on a sensor of a plain name."""
    page, same = Page(html), Page(plain)
    scripts = [sum(tag in DANGEROUS for tag, _ in each.tags) for each in (page, same)]
    assert scripts[0] == scripts[1]
    for tag, attributes in page.tags:
        handlers = [name for name in attributes if name.startswith("on")]
        assert not handlers, (tag, attributes)
        for name in ("href", "src", "xlink:href"):
            value = attributes.get(name) or ""
            assert not value.startswith(("javascript:", "http", "//")), (tag, attributes)
    text = "".join(page.text)
    for name in NAMES[:-1]:
        # What stands in backticks is code, without them.
        assert shown_lines(name).replace("`", "") in text.replace("`", ""), name


def test_reports(folder: Path, repository: Path, tmp_path: Path) -> None:
    check_terminal(ended("report", folder))
    for name in ("calibration.yaml", "metrics.json"):
        (tmp_path / name).write_bytes((repository / "tests" / "files" / name).read_bytes())
    l2m("report", tmp_path)
    plain = (tmp_path / "report.html").read_text()
    check_page((folder / "report.html").read_text(), plain)


@pytest.mark.parametrize(
    "kind",
    [
        *("json", "ros2-launch", "urdf"),
        *(pytest.param(each, marks=pytest.mark.study) for each in OTHERS),
    ],
)
def test_exports(folder: Path, tmp_path: Path, kind: str) -> None:
    out = tmp_path / "made"
    run = ended(
        *("export", folder / "calibration.yaml", "--format", kind),
        *("--out", out, "--despite-verdict"),
    )
    check_terminal(run)
    if run.code:
        assert run.code == 2  # a format that cannot hold such names, or so many sensors, says so
        assert not out.exists()
        return
    text = out.read_text()
    if kind == "json":
        assert set(NAMES) <= set(str(json.loads(text)).split()) | set(_strings(json.loads(text)))
    elif kind in ("kalibr", "bias-scale"):
        assert is_visible(text)
        YAML(typ="safe", pure=True).load(text)
    elif kind == "urdf":
        assert ET.fromstring(text).tag == "robot"  # noqa: S314 - our own
    elif kind == "ros2-launch":
        calls = {
            ast.unparse(each.func)
            for each in ast.walk(ast.parse(text))
            if isinstance(each, ast.Call)
        }
        assert calls <= {"LaunchDescription", "Node", "generate_launch_description"}, calls
    else:
        assert is_visible(text)
        assert all(
            line.startswith("#") or "\t" in line or "," in line for line in text.splitlines()
        )


def _strings(tree: object) -> list[str]:
    """Return all text in plain values, keys included."""
    if isinstance(tree, str):
        return [tree]
    if isinstance(tree, dict):
        return [*_strings(list(tree)), *_strings(list(tree.values()))]
    return [text for each in tree for text in _strings(each)] if isinstance(tree, list) else []


@pytest.mark.study
def test_a_comparison(folder: Path, tmp_path: Path) -> None:
    known = folder / "calibration.yaml"
    words = ("validate", "--calibration", known, "--compare", known, "--out", tmp_path / "out")
    check_terminal(ended(*words))
    html = (tmp_path / "out" / "validation.html").read_text()
    check_page(html, "<html></html>" + "".join(f"<{tag}>" for tag in _scripts(html)))


def _scripts(html: str) -> list[str]:
    """Return the elements of a page that load or run, which are our own where they are first."""
    return [tag for tag, attributes in Page(html).tags if tag == "script" and not attributes]


def test_topics_and_frames_in_the_terminal(tmp_path: Path) -> None:
    dialect, entries = ros("mcap"), []
    for k in range(5):
        stamp = START + 50_000_000 * k
        for name in NAMES:
            message = dialect.magnetic(stamp, (2e-5 + 1e-7 * k, 0.0, 4e-5), name)
            entries.append(Entry(f"/{name}", "sensor_msgs/MagneticField", stamp, message))
    bag = write(tmp_path, "mcap", entries)
    for wide in ((), ("--wide",)):
        check_terminal(ended("inspect", bag, *wide))
    check_terminal(ended("config", "--for", bag))
    check_terminal(ended("calibrate", bag, "--map", tmp_path / NAMES[16], "--out", tmp_path / "o"))
    check_terminal(ended("report", tmp_path / NAMES[18]))


def test_pictures(folder: Path, tmp_path: Path) -> None:
    result, metrics = (
        read_calibration(folder / "calibration.yaml"),
        read_metrics(folder / "metrics.json"),
    )
    stamps = START + 100_000_000 * np.arange(20)
    way = np.column_stack([np.linspace(0, 2, 20), np.zeros(20), np.zeros(20)])
    drive = Trajectory(stamps, np.array([np.eye(3)] * 20), way, "map", "lidar")
    path = tmp_path / "overview.png"
    save_figure(calibration_figure(metrics.map, [drive], result, ()), path)
    with Image.open(path) as picture:
        assert picture.size[0] > 300
        assert len(picture.convert("L").getcolors(1 << 16) or []) > 20


def test_the_page_of_a_fleet() -> None:
    options = FleetOptions()
    plain = [row(day) for day in range(3)]
    page = fleet_page(with_outliers(fleet_rows(), options), options)
    check_page(page, fleet_page(with_outliers(plain, options), options))


def test_the_page_of_a_localisation() -> None:
    page = localisation_page(localisation(), QaOptions(), Identity("0" * 64))
    check_page(page, localisation_page(record(), QaOptions(), Identity("0" * 64)))


@pytest.mark.study
def test_whole_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A drive with a sensor of each name, in a fleet with a vehicle of such a name; and SLAM."""
    monkeypatch.setattr(batch_fleet, "computed", computed_here)
    place, config = make_place(tmp_path / "place"), tmp_path / "config.yaml"
    known = [replace(mounted(PLACE)[0], sensor=name) for name in NAMES]
    bag = write_drive(tmp_path / "drive.mcap", eight(), tuple(known), seed=1)
    start = dict.fromkeys(NAMES, PLACE[0].tolist())
    config.write_text(json.dumps({**CONFIG, "calibration": {"start": start}}))
    fleet, made, found = (tmp_path / name for name in ("fleet", "made", "found"))
    manifest = tmp_path / "fleet.yaml"
    manifest.write_text(json.dumps([{"bag": bag.name, "vehicle": name} for name in NAMES[:2]]))
    as_here = ("--map", place.map, "--config", config)
    check_terminal(ended("batch", manifest, *as_here, "--out", fleet, "--workers", "1"))
    check_terminal(ended("calibrate", bag, *as_here, "--out", made))
    calibration = ("--calibration", made / "calibration.yaml")
    check_terminal(ended("slam", bag, *as_here, *calibration, "--out", found))
    for page in (fleet / "index.html", made / "report.html", found / "report.html"):
        html = page.read_text()
        scripts = _scripts(html)
        assert len(scripts) <= 1  # that sorts the fleet's table
        check_page(html, "".join(f"<{tag}>" for tag in scripts))


def test_the_table_of_a_fleet(tmp_path: Path) -> None:
    """No cell is a formula of a spreadsheet, and each is in its column."""
    named = [
        replace(each, vehicle=printable(each.vehicle), bag=printable(each.bag))
        for each in fleet_rows()
    ]
    write_csv(tmp_path / "fleet.csv", named)
    text = (tmp_path / "fleet.csv").read_text(encoding="utf-8")
    table = list(csv.DictReader(io.StringIO(text)))
    assert len(table) == 3 * len(NAMES)
    for each in table:
        for key in ("vehicle", "bag"):
            assert not (each[key] or "").startswith(("=", "@")), each[key]
            assert is_visible(each[key] or ""), each[key]


def test_names_of_files() -> None:
    made = folder_names(list(NAMES), [str(k) for k in range(len(NAMES))])
    assert len({each.casefold() for each in made}) == len(NAMES)
    for each in made:
        assert is_visible(each)
        assert not set("/\\\n\0:*?\"<>|$`'") & set(each), each
        assert each.strip(". ") == each
        assert len(each.encode()) < 255
