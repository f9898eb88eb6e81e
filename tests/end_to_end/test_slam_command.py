"""`l2m slam` on a bag, and on what it cannot work with."""

import json
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from evo.core import metrics, sync
from evo.tools import file_interface

from l2m_gtsam.batch.reports import report_folder
from l2m_gtsam.data import Distortion
from l2m_gtsam.qa.metrics.trajectory import localised_trajectory
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.bag import read_trajectory
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from l2m_gtsam.storage.record_files import read_slam
from l2m_gtsam.storage.trajectory_files import write_tum
from l2m_gtsam.text import significant
from tests.drives.calibrations import calibration, sensor
from tests.support.command_line import complaint_here, l2m
from tests.support.left_out import no_pages
from tests.worlds.yard import NOISE, Yard, route, survey

LINE = len(route(-3, 0.5)) // 11
NEXT_TO_POST = route(-3, 0.5)[3 * LINE : 8 * LINE]
SIGMA = np.concatenate([np.full(3, 0.01), np.full(9, 0.01), np.full(3, 1.0)])


@pytest.fixture(scope="module")
def past_the_post(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The five lines of the western survey next to the post, whose sensor and poses are the same.

    The others add time to a solve, and hardly any knowledge: their field is nearly uniform.
    """
    return survey(tmp_path_factory.mktemp("past_the_post"), "drive", NEXT_TO_POST, 1)


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sensor of the yard, which sits at the lidar and is ideal."""
    path = tmp_path_factory.mktemp("known") / "known.yaml"
    ideal = sensor(
        "mag",
        t_lidar_mag=np.zeros(3),
        distortion=Distortion.identity(),
        covariance=np.diag(SIGMA**2),
        noise=NOISE,
        time_offset=None,
    )
    write_calibration(path, calibration(ideal))
    return path


def configured(yard: Yard, folder: Path, **slam: object) -> Path:
    """Write the configuration of the yard with options of `slam`."""
    content = json.loads(yard.config.read_text())
    content["slam"] = {"key_poses": {"distance_m": 0.5, "angle_deg": 30, "readings": 3}, **slam}
    path = folder / "slam.yaml"
    path.write_text(json.dumps(content))
    return path


def test_a_drive_is_localised(yard: Yard, field_map: Path, known: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    config = configured(yard, tmp_path, calibration="refined", start={"position_m": 0.02})
    files = ("--map", field_map, "--calibration", known, "--config", config, "--out", out)
    truth = tmp_path / "truth.tum"
    write_tum(truth, read_trajectory(yard.west, BagOptions(poses="/pose")))
    with no_pages():
        run = l2m("slam", yard.west, *files, "--truth", truth)
    assert "localised: the map explains" in run.out
    assert "verdict: " in run.out
    doubts = [
        line for line in l2m("map", "info", field_map).err.splitlines() if "warning: " in line
    ]
    assert doubts
    assert all(f"Of the map: {each.partition('warning: ')[2]}" in run.out for each in doubts)
    told = json.loads((out / "slam.json").read_text())
    assert told["status"] == "localised"
    trajectory = file_interface.read_tum_trajectory_file(str(out / "trajectory.tum"))
    assert trajectory.num_poses == len(told["poses"])
    np.testing.assert_allclose(
        trajectory.positions_xyz, [pose["p"] for pose in told["poses"]], atol=1e-9
    )
    # The poses of this bag are true, but most of the yard has a uniform field, which says nothing
    # of places: half of the 20 cm that odometry is allowed over this way.
    way = route(-3, 0.5)
    apart = np.linalg.norm(trajectory.positions_xyz[:, None] - way, axis=2).min(axis=1)
    assert np.sqrt(np.mean(apart**2)) < 0.1
    # What is told of errors is what evo finds in the files.
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    reference = file_interface.read_tum_trajectory_file(str(truth))
    ape.process_data(sync.associate_trajectories(reference, trajectory))
    rms = ape.get_statistic(metrics.StatisticsType.rmse)
    assert told["truth"]["localised"]["rms_m"] == pytest.approx(rms, rel=1e-6)
    assert f"localised {1e3 * rms:.0f} mm rms" in run.out
    moved = read_trajectory(out / "trajectory.mcap", BagOptions())
    np.testing.assert_allclose(moved.p, trajectory.positions_xyz, rtol=0, atol=1e-9)
    assert moved.covariance is not None
    _, values = gtsam.readG2o(str(out / "graph.g2o"), True)
    assert values.size() == trajectory.num_poses
    refined = read_calibration(out / "refined.yaml")["mag"]
    assert np.all(refined.H_sigma < 1.0)
    # Named as what is written, a file that is missing is still one line.
    assert "no such file" in complaint_here(
        *("slam", yard.west, "--map", field_map, "--calibration", tmp_path / "none.yaml"),
        *("--out", out),
    )
    fixed = configured(yard, tmp_path, calibration="fixed", start={"position_m": 0.02})
    again = l2m("slam", yard.west, *files[:-4], "--config", fixed, "--out", out).out
    # the terminal has the sigma that the page shows and the verdict judges
    sigma = 1e3 * localised_trajectory(read_slam(out / "slam.json")).position_sigma
    known_to = [significant(each, 2) for each in (np.median(sigma), sigma.max())]
    assert f"{known_to[0]} mm in the median, {known_to[1]} mm at worst" in again
    assert (
        f"{known_to[0]} in the median, {known_to[1]} at worst" in (out / "report.html").read_text()
    )
    assert not (out / "refined.yaml").exists()
    check_report(out, tmp_path)


def check_report(out: Path, folder: Path) -> None:
    """A report is rendered from the record alone, and judged by other thresholds on request."""
    page = out / "report.html"
    text = page.read_text()
    assert "counts as exact" in text
    page.unlink()
    assert "verdict: " in l2m("report", out).out
    assert page.read_text() == text
    strict = folder / "strict.yaml"
    strict.write_text("qa: {slam: {position_sigma_m: {warn: 1.0e-6, fail: 2.0e-6}}}")
    with no_pages():
        assert report_folder(out, strict).judgement.level is Level.FAIL
    (out / "metrics.json").write_text("{}")
    assert "holds a calibration (metrics.json) and a localisation" in complaint_here("report", out)
    (out / "metrics.json").unlink()
    record = out / "slam.json"
    record.write_text(record.read_text()[:-100])
    assert "slam.json: not a localisation file" in complaint_here("report", out)


def test_a_drive_without_a_map_makes_one(
    yard: Yard, past_the_post: Path, known: Path, tmp_path: Path
) -> None:
    """The map that comes out is one that another drive can be localised in."""
    out = tmp_path / "out"
    config = configured(yard, tmp_path, start={"position_m": 0.02})
    files = ("--calibration", known, "--config", config)
    run = l2m("slam", past_the_post, *files, "--out", out)
    assert "tiles of field" in run.out
    told = json.loads((out / "slam.json").read_text())
    assert told["explored"]["tiles"] == 1  # of one sensor: one field for the whole drive
    assert [each["role"] for each in told["sources"]] == ["drive", "calibration"]
    assert "found together" in (out / "report.html").read_text()
    own = ("--map", out / "map.npz", "--out", tmp_path / "again")
    with no_pages():
        again = l2m("slam", past_the_post, *files, *own)
    assert "localised: the map explains" in again.out
    lost = configured(yard, tmp_path, start={"anywhere": True})
    line = complaint_here(
        *("slam", past_the_post, "--calibration", known, "--config", lost),
        *("--out", tmp_path / "none"),
    )
    assert "give one with --map" in line
    assert not (tmp_path / "none").exists()


def test_bad_input_is_one_line_and_writes_nothing(
    yard: Yard, field_map: Path, known: Path, tmp_path: Path
) -> None:
    out, config = tmp_path / "out", configured(yard, tmp_path)

    def told(calibration_file: Path, config_file: Path) -> str:
        files = ("--map", field_map, "--calibration", calibration_file)
        return complaint_here("slam", yard.west, *files, "--config", config_file, "--out", out)

    assert "no such file" in told(tmp_path / "none.yaml", config)
    stranger, entry = tmp_path / "stranger.yaml", read_calibration(known)
    write_calibration(stranger, replace(entry, sensors=(replace(entry["mag"], sensor="other"),)))
    assert "none of its sensors (mag) is calibrated; the calibration has other" in told(
        stranger, config
    )
    far = configured(yard, tmp_path, start={"position": [40.0, 0.0, 0.4]})
    assert "the drive is not in this map" in told(known, far)
    late = tmp_path / "late.tum"
    late.write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    files = ("--map", field_map, "--calibration", known, "--config", config, "--out", out)
    for truth, line in (
        (tmp_path / "none.tum", "none.tum: no such file"),
        (known, "is no time in seconds"),
        (late, "late.tum: runs from 1.000 to 2.000 s"),
    ):
        assert line in complaint_here("slam", yard.west, *files, "--truth", truth)
    # The first metres are through a field that is the same everywhere.
    lost = configured(yard, tmp_path, start={"anywhere": True, "search": {"longest_m": 6.0}})
    assert "places of the map or more explain the readings" in told(known, lost)
    wrong = configured(yard, tmp_path, calibration="guessed")
    assert "slam.calibration" in told(known, wrong)
    assert not out.exists()
    out.mkdir()
    (out / "metrics.json").write_text("{}")
    right = configured(yard, tmp_path)
    assert "holds a calibration, whose report would be lost" in told(known, right)
    assert [each.name for each in out.iterdir()] == ["metrics.json"]
