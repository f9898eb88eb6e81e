"""A map that is kept up from the command line: steel comes, goes, and the map tells it."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

from l2m_gtsam.cli.tables.maps import changes_table
from l2m_gtsam.maps.build import map_from_state
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.structure import NO_SOURCES
from l2m_gtsam.qa.report.figures.map_changes import draw_changes
from l2m_gtsam.records.map_diary import UNDATED, Happening, MapDiary, words_of
from l2m_gtsam.records.places import ChangedSource
from l2m_gtsam.storage.map_file import load_map, save_map
from l2m_gtsam.upkeep.dated_changes import dated_changes
from tests.support.command_line import complaint_here, ended, l2m
from tests.support.map_files import copy_map
from tests.worlds.yard import START, make_yard, route, survey, with_steel, world

DAY = 86_400 * 10**9
STEEL, MOMENT = np.array([-1.6, 0.0, 1.0]), np.array([3.0, -2.0, 6.0])
PLACES = np.random.default_rng(3).uniform([-2.5, -1.5, 0.37], [-0.3, 1.5, 0.43], (300, 3))


@dataclass(frozen=True)
class Kept:
    """Maps of the yard's west: of its survey, with steel that was brought, and without it again.

    And the drives of these.
    """

    folder: Path
    config: Path
    suite: Path
    surveyed: Path
    brought: Path
    taken: Path
    drives: tuple[Path, ...]
    cloud: Path


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Kept:
    folder = tmp_path_factory.mktemp("kept")
    yard, suite = make_yard(folder), folder / "suite.yaml"
    suite.write_text(json.dumps({"sensors": {"mag": {"t_lidar_mag": [0, 0, 0]}}}))
    path, steel = route(-3, 0.5), with_steel(STEEL, MOMENT)
    drives = (
        yard.west,
        survey(folder, "second", path, 5, steel, START + DAY),
        survey(folder, "third", path, 6, None, START + 2 * DAY),
    )
    maps = [folder / f"{name}.npz" for name in ("first", "more", "less")]
    found = Kept(folder, yard.config, suite, maps[0], maps[1], maps[2], drives, yard.cloud)
    given = ("--config", yard.config, "--suite", suite)
    l2m("map", "build", yard.west, *given, "--structure", yard.cloud, "--out", found.surveyed)
    for before, drive, after in zip(maps[:-1], drives[1:], maps[1:], strict=True):
        l2m("map", "update", before, drive, *given, "--changes", "--out", after)
    return found


def opened(path: Path) -> HarmonicMap:
    field_map = map_from_state(load_map(path))
    assert isinstance(field_map, HarmonicMap)
    return field_map


def test_what_came_and_went_is_told(kept: Kept) -> None:
    diary = opened(kept.taken).diary
    assert diary is not None
    assert [each.day for each in diary.drives] == ["2023-11-14", "2023-11-15", "2023-11-16"]
    came, went = diary.changes
    assert (came.what, came.before, came.drive) == (Happening.CAME, 0, 1)
    assert (went.what, went.before, went.drive, went.other) == (Happening.WENT, 1, 2, 0)
    for change, moment in ((came, MOMENT), (went, -MOMENT)):
        assert np.linalg.norm(change.source.position - STEEL) < 0.1
        assert np.linalg.norm(change.source.moment - moment) < 0.2 * np.linalg.norm(moment)
    out = l2m("map", "info", kept.taken).out
    assert "What changed: 2 drives since the survey (2023-11-14)" in out
    assert "1 came" in out
    assert "2023-11-14 and 2023-11-15" in out
    assert "2 went (was 1)" in out
    # A cloud need not show all steel: what came may as well have gone.
    assert "or steel of the opposite moment went" in out
    assert "2023-11-15 and 2023-11-16" in out


def test_a_survey_of_all_drives_tells_the_same(kept: Kept) -> None:
    path = kept.folder / "together.npz"
    given = ("--config", kept.config, "--suite", kept.suite, "--structure", kept.cloud)
    out = l2m("map", "build", *reversed(kept.drives), *given, "--out", path).out
    assert "What changed: 2 drives since the survey (2023-11-14)" in out
    one, other = opened(path), opened(kept.taken)
    np.testing.assert_array_equal(one.query(PLACES).field, other.query(PLACES).field)
    assert str(one.diary) == str(other.diary)


def test_without_a_cloud_it_came_or_went(kept: Kept) -> None:
    """Steel of the survey that is taken away is a source of the opposite moment."""
    zero, source = np.zeros(3), np.array([0.5, -1.0, 0.5])
    found = ChangedSource(source, zero + 0.01, -MOMENT, zero + 0.1, zero, 100.0, 0.5, 5.0, 1)
    surveyed = opened(kept.surveyed)
    bare = replace(surveyed.learnt, sources=NO_SOURCES, strengths=np.empty(0))
    blind = HarmonicMap.condition(bare, surveyed.options)
    survey_of = MapDiary((UNDATED,))
    (known,), (change,) = (dated_changes(each, [found], survey_of) for each in (surveyed, blind))
    assert (known.what, change.what) == (Happening.CAME, Happening.EITHER)
    diary = MapDiary((UNDATED, UNDATED), (change,))
    assert words_of(diary, 0) == "came or went"
    again = replace(found, moment=MOMENT)
    (back,) = dated_changes(blind, [again], diary)
    assert (back.what, back.other) == (Happening.WENT, 0)
    picture = kept.folder / "either.png"
    figure, axes = plt.subplots()
    draw_changes(axes, diary)
    figure.savefig(picture)
    plt.close(figure)
    assert list(changes_table(diary).columns[0].cells) == ["1 came or went"]


def test_the_map_is_that_of_the_place_as_it_is(kept: Kept) -> None:
    """As good as after the survey, though the steel makes 6 uT here; and its sigmas hold."""
    steel = with_steel(STEEL, MOMENT)
    first, more, less = (
        opened(path).query(PLACES) for path in (kept.surveyed, kept.brought, kept.taken)
    )
    before, now = (each.field_and_gradient(PLACES)[0] for each in (world(), steel))
    e = [first.field - before, more.field - now, less.field - before]
    rms = [float(np.sqrt(np.mean(each**2))) for each in e]
    z = [
        float(np.sqrt(np.mean(each**2 / sample.variance)))
        for each, sample in zip(e, (first, more, less), strict=True)
    ]
    assert float(np.abs(now - before).max()) > 2
    assert rms[1] < 1.3 * rms[0]  # half of what it knows is of the drive
    assert rms[2] < 1.1 * rms[0]
    assert max(z) < 1.3


def test_a_saved_map_is_the_same(kept: Kept) -> None:
    state = load_map(kept.taken)
    copy = kept.folder / "copy.npz"
    save_map(copy, state)
    assert copy.read_bytes() == kept.taken.read_bytes()
    one, other = opened(kept.taken), opened(copy)
    np.testing.assert_array_equal(one.query(PLACES).field, other.query(PLACES).field)
    assert str(one.diary) == str(other.diary)


def test_the_picture_shows_it(kept: Kept) -> None:
    picture = kept.folder / "map.png"
    l2m("map", "plot", kept.taken, "--out", picture)
    with Image.open(picture) as image:
        wide = image.size[0]
    l2m("map", "plot", kept.surveyed, "--out", picture)
    with Image.open(picture) as image:
        assert image.size[0] < wide


def test_bad_drives_are_one_line_and_leave_the_map(kept: Kept, tmp_path: Path) -> None:
    path = copy_map(kept.taken, tmp_path / "map.npz")
    given = ("--changes", "--out", path)
    short = route(-3, -1.8)

    def refused(drive: Path, *more: str | Path) -> str:
        line = complaint_here("map", "update", path, drive, *more, *given)
        assert path.read_bytes() == kept.taken.read_bytes()
        return line

    known = ("--config", kept.config, "--suite", kept.suite)
    early = survey(tmp_path, "early", short, 8, None, START + DAY // 2)
    assert "give drives in the order of their dates" in refused(early, *known)
    undated = survey(tmp_path, "undated", short, 9, None, DAY)
    assert "which is no date of this century" in refused(undated, *known)
    later = survey(tmp_path, "later", short, 10, None, START + 5 * DAY)
    assert "give its calibration with --suite" in refused(later, "--config", kept.config)
    config = tmp_path / "c.yaml"
    settings = json.loads(kept.config.read_text())
    settings["bag"]["frame"] = "elsewhere"
    config.write_text(json.dumps(settings))
    assert "is in frame 'map'" in refused(later, "--config", config, "--suite", kept.suite)
    turned = tmp_path / "turned.yaml"
    entry = {"t_lidar_mag": [0, 0, 0], "H": [4.0, -3.0, 2.0]}
    turned.write_text(json.dumps({"sensors": {"mag": entry}}))
    settings = json.loads(kept.config.read_text())
    settings["calibration"] = {"changes": {"sources": {"most": 3}}}  # offered to explain it
    config.write_text(json.dumps(settings))
    line = refused(later, "--config", config, "--suite", turned)
    assert "do not read as they are calibrated" in line


def test_an_update_that_ends_half_way_leaves_the_old_map(
    kept: Kept, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = copy_map(kept.taken, tmp_path / "map.npz")
    later = survey(tmp_path, "later", route(-3, 0.5), 10, None, START + 5 * DAY)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(np.lib.format, "write_array", killed)  # in the midst of the file
    given = ("--config", kept.config, "--suite", kept.suite, "--changes", "--out", path)
    assert ended("map", "update", path, later, *given).code != 0
    assert path.read_bytes() == kept.taken.read_bytes()
    assert [each for each in tmp_path.rglob("*") if "npz" in each.name] == [path]


HOSTILE = "<img src=x onerror=alert(1)>\x1b[31m"


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (
            lambda diary: diary.update(drives=diary["drives"][:1]),
            "of a drive that the map does not",
        ),
        (lambda diary: diary["drives"].append(diary["drives"][0]), "history is damaged"),
        (lambda diary: diary["drives"][0].update(begun=HOSTILE), "dates of drives are like"),
        (lambda diary: diary["changes"][0].update(what=HOSTILE), "changes.0.what"),
        (lambda diary: diary["changes"][0].update(other=99), "a change belongs to one that"),
        (lambda diary: diary["changes"][0]["source"].update(position=[1e300, 0, 0]), "position"),
    ],
    ids=["short", "long", "date", "what", "other", "nowhere"],
)
def test_a_spoilt_diary_is_one_line(
    kept: Kept, tmp_path: Path, spoil: Callable[[Any], None], told: str
) -> None:
    state, path = load_map(kept.taken), tmp_path / "map.npz"
    diary = json.loads(json.dumps(state.provenance["diary"]))
    spoil(diary)
    save_map(path, replace(state, provenance={**state.provenance, "diary": diary}))
    line = complaint_here("map", "info", path)
    assert str(path) in line
    assert told in line
    assert "\x1b" not in line


def test_a_diary_of_another_map_is_one_line(kept: Kept, tmp_path: Path) -> None:
    state, path = load_map(kept.surveyed), tmp_path / "map.npz"
    diary = load_map(kept.taken).provenance["diary"]
    save_map(path, replace(state, provenance={**state.provenance, "diary": diary}))
    assert "it is of another map" in complaint_here("map", "info", path)


def test_maps_that_cannot_be_read_or_written_are_one_line(kept: Kept, tmp_path: Path) -> None:
    later = survey(tmp_path, "later", route(-3, 0.5), 10, None, START + 5 * DAY)
    given = (later, "--config", kept.config, "--suite", kept.suite, "--changes", "--out")
    whole, path = kept.taken.read_bytes(), tmp_path / "map.npz"
    for count in (10, len(whole) // 2, len(whole) - 30):
        path.write_bytes(whole[:count])
        assert "damaged" in complaint_here("map", "update", path, *given, path)
        assert path.read_bytes() == whole[:count]
    folder, below = tmp_path / "folder.npz", kept.suite / "map.npz"
    folder.mkdir()
    assert "not a regular file" in complaint_here("map", "update", kept.taken, *given, folder)
    assert "is a file" in complaint_here("map", "update", kept.taken, *given, below)
    named = tmp_path / "named.yaml"
    named.write_text(json.dumps({"sensors": {HOSTILE: {"t_lidar_mag": [0, 0, 0]}}}))
    hostile = (later, "--config", kept.config, "--suite", named, "--changes", "--out", path)
    line = complaint_here("map", "update", kept.taken, *hostile)
    assert "does not list the sensor" in line
    assert "\x1b" not in line
