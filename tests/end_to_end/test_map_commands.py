"""Building, updating and comparing maps from the command line."""

import json
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.build import map_from_state
from l2m_gtsam.maps.harmonic import compiled, tiles
from l2m_gtsam.storage.files import source_file
from l2m_gtsam.storage.map_file import load_map
from tests.support.command_line import complaint_here, l2m, l2m_process
from tests.worlds.quick_maps import QUICK_HARMONIC
from tests.worlds.yard import POST, Yard, make_yard, world

# About what is learnt from the whole run.
OPTITRACK_PRIOR = {"floor_scale": 7.8, "floor_depth": 0.5, "noise": 0.35}


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Yard:
    return make_yard(tmp_path_factory.mktemp("yard"))


@pytest.fixture(scope="module")
def bare(yard: Yard) -> Path:
    """The map of the west without a structure."""
    path = yard.west.parent / "bare.npz"
    l2m("map", "build", yard.west, "--config", yard.config, "--out", path)
    return path


@pytest.fixture(scope="module")
def sliding(yard: Yard) -> Path:
    """The paper's map of the west."""
    path = yard.west.parent / "sliding.npz"
    l2m("map", "build", yard.west, "--config", yard.sliding, "--out", path)
    return path


def places() -> FloatArray:
    """Between the lines of the drive in the west, at least 25 cm from the post."""
    points = np.random.default_rng(3).uniform([-2.5, -1.5, 0.35], [0.3, 1.5, 0.5], (500, 3))
    return np.asarray(points[np.linalg.norm(points[:, :2] - POST, axis=1) > 0.25])


def error_of(path: Path) -> float:
    """Return the rms error of a map near the post in microtesla."""
    truth, _ = world().field_and_gradient(places())
    sample = map_from_state(load_map(path)).query(places())
    return float(np.sqrt(np.mean((sample.field - truth)[sample.inside] ** 2)))


def test_what_speaks_against_a_map_is_a_warning(bare: Path) -> None:
    """A post that the map does not know of; each doubt is a line of the error stream."""
    doubts = map_from_state(load_map(bare)).summary.doubts
    run = l2m("map", "info", bare)
    warned = [line for line in run.err.splitlines() if line.startswith("l2m: warning: ")]
    assert warned == [f"l2m: warning: {doubt}" for doubt in doubts]
    assert any("does not explain the field" in line for line in warned)


def test_a_structure_file_makes_a_better_map(yard: Yard, bare: Path, tmp_path: Path) -> None:
    path = tmp_path / "new" / "map.npz"
    arguments = ("--config", yard.config, "--structure", yard.cloud, "--out", path)
    out = l2m("map", "build", yard.west, *arguments).out
    source = source_file(yard.cloud)
    assert load_map(path).provenance["structure"] == vars(source)
    assert f"path {yard.cloud}, sha256 {source.sha256}" in out
    assert f"written: {path}" in out
    assert l2m("map", "info", path).out.count(source.sha256) == 1
    # Sources in the right place explain what modes of 200 weights cannot.
    assert error_of(path) < 0.5 * error_of(bare)


def test_a_structure_topic_is_as_good_as_the_file(yard: Yard, bare: Path, tmp_path: Path) -> None:
    """Its scans are placed by the poses of the bag; one of them is older than all poses."""
    path = tmp_path / "map.npz"
    bags = (yard.west, yard.east)
    arguments = ("--config", yard.config, "--structure", "points", "--out", path)
    out = l2m("map", "build", *bags, *arguments).out
    structure = load_map(path).provenance["structure"]
    assert structure["topic"] == "points"
    assert structure["scans_without_pose"] == 2
    assert f"topic points, scans {structure['scans']}, scans without pose 2" in out
    assert error_of(path) < 0.5 * error_of(bare)


def test_an_updated_map_is_that_of_all_readings(yard: Yard, sliding: Path, tmp_path: Path) -> None:
    """Given hyperparameters, and few enough readings in a cube that all of them count."""
    path, all_path = tmp_path / "map.npz", tmp_path / "all.npz"
    path.write_bytes(sliding.read_bytes())
    out = l2m("map", "update", path, yard.east, "--config", yard.sliding, "--out", path).out
    bags = (yard.west, yard.east)
    l2m("map", "build", *bags, "--config", yard.sliding, "--out", all_path)
    updated, at_once = (map_from_state(load_map(each)) for each in (path, all_path))
    rng = np.random.default_rng(6)
    points = rng.uniform([-3, -2, 0.3], [3, 2, 0.5], (400, 3))
    one, other = updated.query(points), at_once.query(points)
    np.testing.assert_array_equal(one.inside, other.inside)
    # Means of means, by a factor of condition 1e5; the cubes are cut alike.
    np.testing.assert_allclose(one.field, other.field, rtol=0, atol=1e-7)
    np.testing.assert_allclose(one.variance, other.variance, rtol=0, atol=1e-7)
    assert [bag["path"] for bag in load_map(path).provenance["bags"]] == [str(b) for b in bags]
    assert all(str(bag) in out for bag in bags)
    assert load_map(path).provenance["config"] == load_map(sliding).provenance["config"]


def test_a_calibration_with_kept_tiles_makes_none(
    yard: Yard, bare: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = yard.west.parent / "kept"
    monkeypatch.setattr(tiles, "solved_tile", None)
    monkeypatch.setattr(compiled, "compile_tile", None)
    run = l2m("calibrate", yard.west, "--map", bare, "--config", yard.config, "--out", out)
    assert ".tiles" not in run.err


def test_damaged_tiles_are_one_warning(bare: Path) -> None:
    picture = bare.with_suffix(".png")
    for path in bare.with_suffix(".tiles").glob("*.solved.tile"):
        path.write_bytes(path.read_bytes()[:-1])
    run = l2m("map", "plot", bare, "--out", picture)
    said = [line for line in run.err.splitlines() if ".tiles" in line]
    assert len(said) == 1
    assert said[0].startswith("l2m: warning: ")
    assert ".tiles" not in l2m("map", "plot", bare, "--out", picture).err


def test_tiles_are_left_to_the_first_use_on_request(yard: Yard) -> None:
    path = yard.west.parent / "later.npz"
    l2m("map", "build", yard.west, "--config", yard.config, "--out", path, "--no-tiles")
    assert not path.with_suffix(".tiles").exists()


def test_an_updated_harmonic_map_knows_the_new_place(
    yard: Yard, bare: Path, tmp_path: Path
) -> None:
    path, before = tmp_path / "map.npz", bare.read_bytes()
    l2m("map", "update", bare, yard.east, "--config", yard.config, "--out", path)
    assert bare.read_bytes() == before
    old, new = (map_from_state(load_map(each)) for each in (bare, path))
    east = np.random.default_rng(7).uniform([1.5, -1.5, 0.4], [2.5, 1.5, 0.4], (50, 3))
    assert not old.query(east).inside.any()
    found, (truth, _) = new.query(east), world().field_and_gradient(east)
    assert found.inside.all()
    # 0.1 uT of noise, and a field that is smooth there.
    assert np.sqrt(np.mean((found.field - truth) ** 2)) < 0.1
    assert new.summary.readings > 1.8 * old.summary.readings


@pytest.mark.parametrize(
    ("structure", "best"), [((), "sliding_gp"), (("--structure", "/points"), "harmonic")]
)
def test_kinds_are_compared(yard: Yard, structure: tuple[str, ...], best: str) -> None:
    """A post in the middle of the survey is beyond floor and ceiling modes without sources."""
    out = l2m("map", "compare", yard.west, "--config", yard.config, *structure).out
    rows = {kind: out.count(f"\n{kind} ") for kind in ("harmonic", "sliding_gp", "bilinear")}
    assert rows == {"harmonic": 1, "sliding_gp": 1, "bilinear": 1}
    assert f"recommended: {best}; the log-likelihood of {best} is" in out
    assert "failed" not in out


def test_kinds_are_compared_on_a_real_run(
    shared_data: Path, repository: Path, tmp_path: Path
) -> None:
    """As a user would, but for the size of the harmonic map and what it would learn."""
    run = shared_data / "bags" / "optitrack_run0_ros2_sqlite"
    config = tmp_path / "c.yaml"
    text = (repository / "configs" / "optitrack.yaml").read_text()
    model = {"harmonic": QUICK_HARMONIC | {"hyperparameters": OPTITRACK_PRIOR}}
    config.write_text(text.replace("{kind: sliding_gp}", json.dumps(model)))
    out = l2m("map", "compare", run, "--config", config).out
    # An area of 2.3 by 2.1 m cannot be cut into patches of the usual 1.5 m.
    assert "patches of 0.492 m, held out in 4 folds" in out
    assert "recommended: " in out
    assert "failed" not in out


def test_bad_structures_are_one_line(yard: Yard, tmp_path: Path) -> None:
    out = tmp_path / "out" / "map.npz"
    truncated = tmp_path / "cut.ply"
    truncated.write_bytes(yard.cloud.read_bytes()[:-5])

    def build(structure: str | Path) -> str:
        given = ("--config", yard.config, "--structure", structure)
        return complaint_here("map", "build", yard.west, *given, "--out", out)

    assert "nowhere.pcd: no such point cloud" in build(tmp_path / "nowhere.pcd")
    assert "cloud.obj: not a kind of point cloud that is read" in build("cloud.obj")
    assert "cut.ply: not a usable point cloud" in build(truncated)
    assert "no topic '/lidar'; with clouds there are: /points" in build("/lidar")
    assert "topic /mag is of type sensor_msgs/msg/MagneticField" in build("/mag")
    line = complaint_here("map", "compare", yard.west, "--structure", tmp_path / "nowhere.pcd")
    assert "nowhere.pcd: no such point cloud" in line
    assert not out.parent.exists()


def test_a_structure_for_a_kind_that_cannot_use_it(yard: Yard, tmp_path: Path) -> None:
    """Refused before the bags are read: this one is not there."""
    given = ("nowhere.bag", "--structure", yard.cloud, "--config")
    line = complaint_here("map", "build", *given, yard.sliding, "--out", tmp_path / "map.npz")
    assert "maps of kind sliding_gp cannot use a structure cloud" in line
    config = tmp_path / "c.yaml"
    config.write_text("mapping: {compare: {kinds: [sliding_gp, bilinear]}}")
    line = complaint_here("map", "compare", *given, config)
    assert "maps of kind sliding_gp, bilinear cannot use a structure cloud" in line
    assert list(tmp_path.iterdir()) == [config]


def test_bad_updates_leave_everything_as_it_was(yard: Yard, sliding: Path, tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    config = tmp_path / "c.yaml"
    settings = json.loads(yard.sliding.read_text())
    settings["bag"]["frame"] = "elsewhere"
    config.write_text(json.dumps(settings))

    def update(bag: Path, config: Path = yard.sliding) -> str:
        before = path.read_bytes()
        line = complaint_here("map", "update", path, bag, "--config", config, "--out", path)
        assert path.read_bytes() == before
        return line

    path.write_bytes(sliding.read_bytes())
    assert "is in frame 'map', the poses of" in update(yard.east, config)
    assert f"was made from {yard.west} already" in update(yard.west)
    assert "nowhere.bag: no such file" in update(tmp_path / "nowhere.bag")
    path.write_bytes(sliding.read_bytes()[:-1000])
    assert "map.npz: not a map file of this program, or damaged" in update(yard.east)
    line = complaint_here("map", "update", sliding, yard.east, "--out", tmp_path / "map.zip")
    assert "the name must end in .npz" in line
    assert sorted(tmp_path.iterdir()) == [config, path]


def test_the_version_is_told() -> None:
    assert l2m_process("--version").out.startswith("l2m 0.")
