"""The study of SLAM with several sensors: its page, from made-up cells, and what its cells use."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from l2m_gtsam.data import Distortion, FieldSeries, KnownSensor, Recording, SourceFile, Trajectory
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.studies.slam.methods import MethodRow, given_sensors
from l2m_gtsam.studies.slam.study import SLAM
from l2m_gtsam.studies.slam_array.methods import SlamArrayCell, SlamArrayOptions, apart
from l2m_gtsam.studies.slam_array.places import array, robot, strengths
from l2m_gtsam.studies.slam_array.study import SLAM_ARRAY
from l2m_gtsam.studies.study import Study


def test_what_is_lost_is_on_the_page() -> None:
    options = SlamArrayOptions(recordings=("robot-1", "array-6"), seeds=2)
    keys = SLAM_ARRAY.keys(options)
    assert len(keys) == len(set(keys)) == 8
    alone = MethodRow(0.2, None, 0.0)
    good, bad = MethodRow(0.02, 6.0, 50.0, False, 0.95, 90.0), MethodRow(0.3, 40.0, 50.0)
    kept = MethodRow(0.2, 2.0, 50.0, True, 1.0, 90.0)
    cells = {
        key: SlamArrayCell(
            path_m=30.0,
            sensors=3,
            odometry=alone,
            particles=bad if key == "robot-1-slip-1" else good,
            map_online=good,
            map_ours=good,
            online=good,
            ours=kept if "walk" in key else good,
            near_loops_m=0.25,
            wide_loops_m=0.05,
        )
        for key in keys
    }
    summary = SLAM_ARRAY.summarise(options, cells)
    assert [row.ours.removed for row in summary.rows] == pytest.approx([0.9, 0.0, 0.9, 0.0])
    page = SLAM_ARRAY.page(summary)
    assert "worse than its odometry: robot 1, slip (map: particle filter)." in page
    assert "no gain is shown: robot 1, walk (2); array 6, walk (2) seeds." in page
    assert "| robot 1 | 3, 30 m | slip | 200 | 160 | 20 | 20 | 20 | 20 | 90 % | 90 % |" in page
    assert "| robot 1 | walk | 250, -25 % | 50, 75 % | 200, 0 % |" in page
    assert "*Robot* is" in page
    assert "we simulate" not in page
    assert set(SLAM_ARRAY.figures(summary)) == {"slam-array"}
    simulated = replace(summary.rows[0], site="warehouse 1")
    page = SLAM_ARRAY.page(replace(summary, rows=(simulated,)))
    assert "*Warehouse* is our simulation" in page
    assert "*Robot* is" not in page


def test_steps_of_the_particle_filter_are_a_tenth_of_a_metre_apart() -> None:
    p = np.column_stack([np.linspace(0, 1, 101), np.zeros((101, 2))])
    rows = apart(p)
    assert rows[0] == 0
    # A place on the boundary of a piece may count to the one before, by rounding.
    np.testing.assert_allclose(np.diff(p[rows, 0]), 0.1, atol=0.0101)


def test_strengths_are_those_of_the_field_whatever_a_sensor_does_to_it() -> None:
    """Two sensors of other C and H in one field that grows, between readings, and beyond them."""
    stamps = 10**8 * np.arange(11, dtype=np.int64)
    field = np.outer(np.linspace(30, 50, 11), [0.6, 0.0, -0.8])
    rng = np.random.default_rng(1)
    distortions = [
        Distortion(np.eye(3) + 0.1 * rng.normal(size=(3, 3)), 10 * rng.normal(size=3))
        for _ in range(2)
    ]
    known = [KnownSensor(f"mag_{i}", np.zeros(3), each) for i, each in enumerate(distortions)]
    series = tuple(
        FieldSeries(each.sensor, "/" + each.sensor, "lidar", stamps, each.distortion.apply(field))
        for each in known
    )
    poses = Trajectory(stamps, np.tile(np.eye(3), (11, 1, 1)), np.zeros((11, 3)), "map", "lidar")
    recording = Recording(poses, series, SourceFile("drive", ""))
    at = np.array([0, 5 * 10**7, 2 * 10**9])
    found = strengths(recording, given_sensors(known[::-1], 0.1), at)  # in the calibration's order
    np.testing.assert_allclose(found[:2], [[30.0, 30.0], [31.0, 31.0]], rtol=1e-12)
    assert np.isnan(found[2]).all()


def test_a_run_of_the_map_is_no_drive_through_it(tmp_path: Path, shared_data: Path) -> None:
    with pytest.raises(ConfigError, match="run 3 is not one of 5 to 9"):
        array(shared_data, 3)
    with pytest.raises(ConfigError, match="no run 6 of the array can be read"):
        array(tmp_path, 6)


@pytest.mark.parametrize("study", [SLAM, SLAM_ARRAY])
@pytest.mark.parametrize("site", ["submarine-1", "robot", "robot-one", "robot-1-2"])
def test_a_recording_that_is_none_is_named(study: Study[Any, Any, Any], site: str) -> None:
    """As it is written, and before anything is computed."""
    with pytest.raises(ConfigError, match=f"'{site}' is none; they are named like"):
        study.keys(study.options(recordings=("robot-1", site)))


def test_a_pass_that_there_is_not_is_named(shared_data: Path) -> None:
    with pytest.raises(ConfigError, match="pass 9 is not one of 1 to 4"):
        robot(shared_data, 9)
