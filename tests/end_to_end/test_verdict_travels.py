"""No path through the commands turns a FAIL into a file without a verdict."""

import csv
import json
import shutil
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from ruamel.yaml import YAML

from l2m_gtsam.batch import fleet as batch_fleet
from l2m_gtsam.cli.app import app
from l2m_gtsam.cli.maps import map_app
from l2m_gtsam.errors import Notice
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.calibrated_topics import VERDICT_TOPIC
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.known_sensors import read_known_sensors
from l2m_gtsam.storage.open_bag import open_bag
from tests.drives.yard import CalibratedYard, written
from tests.support.command_line import Finished, ended, l2m, one_line
from tests.support.one_process import computed_here
from tests.support.records import validation_in

pytestmark = pytest.mark.usefixtures("without_pages", "texts_read_once")

FORMATS = ("ros2-launch", "urdf", "kalibr", "json", "bias-scale", "px4", "ardupilot")
ROBOT = '<robot name="r">\n  <link name="lidar"/>\n</robot>\n'
SHORT = 150  # poses, three lines of the route
LOOSE, TIGHT, NEVER = ({"warn": limit, "fail": limit} for limit in (1e6, 1e-9, 1e-9))
LIMITS = (
    *("position_sigma_m", "rotation_sigma_deg", "hard_iron_sigma_ut", "unexplained", "rejected"),
    *("outside_map", "halves_apart", "chi_square", "time_offset_s", "scale", "skew_deg"),
)
LAX = dict.fromkeys(LIMITS, LOOSE)
THRESHOLDS: dict[str, dict[str, Any]] = {
    "fail": {**LAX, "position_sigma_m": TIGHT},
    "warn": {**LAX, "position_sigma_m": {"warn": 1e-9, "fail": 1e6}},
    "other warn": {**LAX, "hard_iron_sigma_ut": {"warn": 1e-9, "fail": 1e6}},
}


def config(folder: Path, name: str) -> Path:
    """Write a configuration with thresholds that lead to a verdict."""
    path = folder / f"{name.replace(' ', '_')}.yaml"
    path.write_text(json.dumps({"qa": THRESHOLDS[name]}))
    return path


def stated(bag: Path) -> dict[str, Any]:
    """Return the last verdict that a corrected bag states."""
    with open_bag(bag) as opened:
        topics = [c for c in opened.connections if c.topic.startswith(VERDICT_TOPIC)]
        messages = [each.content.data for each in opened.messages(topics)]
    found = json.loads(messages[-1])
    assert isinstance(found, dict)
    return found


class Commands(RuleBasedStateMachine):
    """Commands in any order on one calibration, whose verdicts are known beforehand."""

    place: CalibratedYard
    folder: Path
    bags: dict[str, Path]
    runs = count()

    @initialize(first=st.sampled_from(sorted(THRESHOLDS)))
    def start(self, first: str) -> None:
        self.here = self.folder / f"run_{next(self.runs)}"
        self.here.mkdir()
        for name in ("calibration.yaml", "metrics.json"):
            shutil.copy(self.place.calibration.parent / name, self.here)
        self.seen: list[tuple[Level, str]] = []
        self.report(first)

    @property
    def level(self) -> Level:
        return self.seen[-1][0]

    @rule(name=st.sampled_from(sorted(THRESHOLDS)))
    def report(self, name: str) -> None:
        run = l2m("report", self.here, "--config", config(self.folder, name))
        level = Level(name.split()[-1])
        assert f"verdict: {level.upper()}" in run.out
        if not self.seen or self.seen[-1][1] != name:
            self.seen.append((level, name))
        others = {each.upper() for each, _ in self.seen if each is not level}
        assert all(f"the verdict was {each} before" in run.err for each in others)

    @rule()
    def report_again(self) -> None:
        """Without thresholds a report is rendered with those it was judged by."""
        assert f"verdict: {self.level.upper()}" in l2m("report", self.here).out

    @rule(name=st.sampled_from(FORMATS), despite=st.booleans(), into=st.booleans())
    def export(self, name: str, despite: bool, into: bool) -> None:
        out = self.here / f"export_{next(self.runs)}"
        arguments: list[str | Path] = ["--format", name, "--out", out]
        if into and name == "urdf":
            robot = self.folder / "robot.urdf"
            robot.write_text(ROBOT)
            arguments += ["--into", robot]
        arguments += ["--despite-verdict"] if despite else []
        run = ended("export", self.here / "calibration.yaml", *arguments)
        if self.refused(run, out, despite):
            return
        text = out.read_text()
        if name == "json":
            found = json.loads(text)["verdict"]
            assert found["level"] == self.level
            self.check_thresholds(found["thresholds"])
        else:
            assert f"verdict: {self.level.upper()}" in text
            assert "judged by qa: " in text
        for level in {each for each, _ in self.seen}:
            assert level.upper() in text or f'"{level}"' in text

    @rule(kind=st.sampled_from(("ros1", "sqlite3", "mcap")), despite=st.booleans())
    def apply(self, kind: str, despite: bool) -> None:
        out = self.here / f"bag_{next(self.runs)}{'.bag' if kind == 'ros1' else ''}"
        arguments = ["--despite-verdict"] if despite else []
        calibration = self.here / "calibration.yaml"
        common = ("apply", self.bags[kind], "--calibration", calibration, "--out", out)
        if not self.refused(ended(*common, *arguments), out, despite):
            found = stated(out)["verdict"]
            assert found["level"] == self.level
            self.check_thresholds(found["thresholds"])

    @precondition(lambda self: any(each is Level.FAIL for each, _ in self.seen))
    @invariant()
    def a_fail_is_remembered(self) -> None:
        judged = read_calibration(self.here / "calibration.yaml").judgement
        assert judged is not None
        assert Level.FAIL in (judged.level, *(each.level for each in judged.earlier))

    def refused(self, run: Finished, out: Path, despite: bool) -> bool:
        """Check that a FAIL is refused, but where it was asked for, and return whether it was."""
        if self.level is Level.FAIL and not despite:
            assert "give --despite-verdict" in one_line(run)
            assert not out.exists()
            return True
        assert run.code == 0
        assert f"its verdict is {self.level.upper()}" in run.err
        return False

    def check_thresholds(self, found: dict[str, Any]) -> None:
        """Check that thresholds are those of the last judgement."""
        wanted = THRESHOLDS[self.seen[-1][1]]
        assert {name: found[name] for name in wanted} == wanted


def test_a_fail_leaves_no_file_without_a_verdict(place: CalibratedYard, tmp_path: Path) -> None:
    """Six walks of six commands."""
    Commands.place, Commands.folder = place, tmp_path
    kinds = {"ros1": "ros1", "sqlite3": "sqlite3", "mcap": "mcap"}
    Commands.bags = {kind: written(tmp_path, kind, f"drive_{kind}") for kind in kinds}
    machine: Any = Commands.TestCase
    machine.settings = settings(
        max_examples=6,
        stateful_step_count=6,
        deadline=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
    machine().runTest()


def test_an_old_calibration_counts_as_not_judged(place: CalibratedYard, tmp_path: Path) -> None:
    """It is read, used and said to be not judged, in one line; a report judges it."""
    yaml: Any = YAML(typ="safe", pure=True)
    content = yaml.load(place.calibration.read_text())
    del content["verdict"], content["id"]
    old, out = tmp_path / "calibration.yaml", tmp_path / "mag.json"
    with old.open("w") as file:
        yaml.dump(content, file)
    run = l2m("export", old, "--format", "json", "--out", out)
    (line,) = run.err.splitlines()
    assert line == f"l2m: warning: {old}: not judged; it holds no verdict"
    assert json.loads(out.read_text())["verdict"] == {"level": "not judged"}
    shutil.copy(place.calibration.parent / "metrics.json", tmp_path)
    l2m("report", tmp_path)
    assert read_calibration(old).judgement == read_calibration(place.calibration).judgement


def test_an_edited_verdict_is_refused(place: CalibratedYard, tmp_path: Path) -> None:
    """Beside its run's results it is not theirs; alone, the level contradicts its reasons."""
    shutil.copy(place.calibration.parent / "metrics.json", tmp_path)
    edited = tmp_path / "calibration.yaml"
    shutil.copy(place.calibration, edited)
    l2m("report", tmp_path, "--config", config(tmp_path, "fail"))
    edited.write_text(edited.read_text().replace("level: fail", "level: pass", 1))
    beside = ended("export", edited, "--format", "json", "--out", tmp_path / "x")
    assert "is not of the run" in one_line(beside)
    (alone := tmp_path / "alone").mkdir()
    run = ended("export", shutil.copy(edited, alone), "--format", "json", "--out", tmp_path / "x")
    assert "verdict.level: PASS does not follow from its reasons" in one_line(run)


def test_a_suite_that_failed_is_named(place: CalibratedYard, tmp_path: Path) -> None:
    """Maps are built from calibrations, too."""
    for name in ("metrics.json", "calibration.yaml"):
        shutil.copy(place.calibration.parent / name, tmp_path)
    l2m("report", tmp_path, "--config", config(tmp_path, "fail"))
    with pytest.warns(Notice, match="its verdict is FAIL"):
        read_known_sensors(tmp_path / "calibration.yaml")


@dataclass(frozen=True)
class Failed:
    """A calibration that was judged FAIL, and configurations that lead to a FAIL everywhere."""

    folder: Path
    calibration: Path
    config: Path


@pytest.fixture
def failed(place: CalibratedYard, tmp_path: Path) -> Failed:
    for name in ("metrics.json", "calibration.yaml"):
        shutil.copy(place.calibration.parent / name, tmp_path)
    l2m("report", tmp_path, "--config", config(tmp_path, "fail"))
    content = json.loads((place.calibration.parent / "c.yaml").read_text())
    sigmas = {"position_sigma_m": TIGHT, "heading_sigma_deg": TIGHT}
    content["qa"] = {**THRESHOLDS["fail"], "rejected": TIGHT, "unexplained": TIGHT, "slam": sigmas}
    content["slam"] = {"key_poses": {"distance_m": 0.5, "angle_deg": 30}}
    (tmp_path / "failing.yaml").write_text(json.dumps(content))
    return Failed(tmp_path, tmp_path / "calibration.yaml", tmp_path / "failing.yaml")


JUDGING = {"calibrate", "validate", "slam", "batch", "report"}
USING = {"export", "apply", "validate", "slam", "map build", "map update", "map suite"}
NEITHER = {
    *("inspect", "config", "plan", "demo", "simulate", "study"),
    *("map compare", "map info", "map plot"),
}
"""Of the commands: which judge, which make a file of a calibration, and which do neither."""


def test_every_command_is_known_here() -> None:
    """A new one has to say what it does with a FAIL, and then be tried below."""
    commands = {getattr(each.callback, "__name__", "") for each in app.registered_commands}
    below = {f"map {each.name}" for each in map_app.registered_commands}
    assert commands | below == JUDGING | USING | NEITHER


def strict_command(place: CalibratedYard, failed: Failed, name: str) -> list[str | Path]:
    """Return a command that ends with a FAIL."""
    common: list[str | Path] = ["--map", place.map, "--config", failed.config]
    other = written(failed.folder, "mcap", "other", seed=8)
    if name == "calibrate":
        return ["calibrate", other, *common]
    if name == "batch":
        return ["batch", other, *common, "--workers", "1"]
    return [name, other, "--calibration", failed.calibration, *common]


@pytest.mark.parametrize("name", ["batch", "calibrate", "validate"])
def test_strict_ends_with_three(
    place: CalibratedYard, failed: Failed, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything is written; only the exit code differs. `slam` is tried below."""
    monkeypatch.setattr(batch_fleet, "computed", computed_here)
    command, out = strict_command(place, failed, name), failed.folder / "out"
    run = ended(*command, "--out", out, "--strict")
    assert run.code == 3, run.err
    assert "verdict: FAIL" in run.out or "1 fail" in run.out
    written_file = {"calibrate": "report.html", "batch": "index.html"}
    assert (out / written_file.get(name, "validation.json")).is_file()
    if name in ("batch", "validate"):  # quick the second time
        assert ended(*command, "--out", out).code == 0
    if name in ("calibrate", "batch"):
        for path in failed.folder.rglob("out/**/calibration.yaml"):
            judged = read_calibration(path).judgement
            assert judged is not None
            assert judged.level is Level.FAIL
    if name == "batch":
        with (out / "fleet.csv").open(encoding="utf-8", newline="") as file:
            assert {row["verdict"] for row in csv.DictReader(file)} == {"fail"}


def test_a_passed_strict_run_ends_with_nought(place: CalibratedYard, tmp_path: Path) -> None:
    lax = config(tmp_path, "warn")
    common = ("--calibration", place.calibration, "--compare", place.calibration)
    assert ended("validate", *common, "--config", lax, "--strict").code == 0


def test_what_a_failed_calibration_was_used_for_says_so(
    place: CalibratedYard, failed: Failed
) -> None:
    """Validations, localisations, maps, suites, and what is calibrated on such a map."""
    folder, quick = failed.folder, place.yard.config
    files = ("--calibration", failed.calibration, "--map", place.map)
    drive = written(folder, "mcap", "other", seed=8)
    short = written(folder, "mcap", "short", seed=9, poses=SHORT)
    l2m("validate", drive, *files, "--out", folder / "valid")
    l2m("validate", *files[:2], "--compare", place.calibration, "--out", folder / "compared")
    for name in ("valid", "compared"):
        verdict = validation_in(folder / name / "validation.json").verdict
        assert any("judged FAIL" in each.text for each in verdict.reasons)
        assert verdict.level is not Level.PASS
    common = ("--config", failed.config, "--out", folder / "path")
    assert ended("slam", short, *files, *common, "--strict").code == 3
    assert "is FAIL" in " ".join(json.loads((folder / "path" / "slam.json").read_text())["notes"])
    suite, field_map, more = ("--suite", failed.calibration), folder / "m.npz", folder / "more.npz"
    quickly = ("--config", quick, "--no-tiles")
    l2m("map", "build", drive, *suite, *quickly, "--out", field_map)
    l2m("map", "update", place.map, drive, *suite, *quickly, "--out", more)
    for made in (field_map, more):
        assert "whose verdict is FAIL" in l2m("map", "info", made).err
    once = folder / "once.yaml"  # enough for what is looked at here
    little = {"searches": 0, "windows": 1, "readings": 300, "modes": 60}
    once.write_text(json.dumps({**json.loads(quick.read_text()), "mapping": {"suite": little}}))
    l2m("map", "suite", short, *suite, "--config", once, "--out", folder / "suite.yaml")
    assert "whose verdict is FAIL" in " ".join(read_calibration(folder / "suite.yaml").doubts)
    start = ("--config", place.calibration.parent / "c.yaml")
    l2m("calibrate", place.drive, "--map", field_map, *start, "--out", folder / "on_it")
    on_it = read_calibration(folder / "on_it" / "calibration.yaml")
    assert any("whose verdict is FAIL" in each for each in on_it.doubts)
    assert on_it.judgement is not None
    assert on_it.judgement.level is not Level.PASS
