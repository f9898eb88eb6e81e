"""Several bags at the command line."""

from pathlib import Path

from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.record_files import read_metrics
from tests.drives.begun import begin
from tests.support.command_line import complaint_here, l2m
from tests.support.computed_once import computed_once

SECONDS = 40.0  # of drives of 104 and 101


def test_bags_that_are_missing_or_given_twice(tmp_path: Path) -> None:
    """Said before map and bags are read."""
    (tmp_path / "link.bag").symlink_to(tmp_path / "a.bag")
    rest = ("--map", tmp_path / "map.npz", "--out", tmp_path / "out")
    assert "no bag is given: name one or several" in complaint_here("calibrate", *rest)
    for again in ("a.bag", "link.bag", "../" + tmp_path.name + "/a.bag"):
        twice = (tmp_path / "a.bag", "--bag", tmp_path / again)
        assert "is listed twice" in complaint_here("calibrate", *twice, *rest)
    assert not (tmp_path / "out").exists()


def test_two_real_drives(shared_data: Path, tmp_path: Path, repository: Path) -> None:
    """A handheld sensor under a motion-capture system, on the map of the first drive."""
    bags, config = shared_data / "bags", repository / "configs" / "optitrack.yaml"
    first, second = bags / "optitrack_run0_ros1.bag", bags / "optitrack_run1_ros1.bag"
    map_path, out = tmp_path / "map.npz", tmp_path / "out"
    with computed_once():  # the map of test_optitrack_commands.py
        l2m("map", "build", first, "--config", config, "--out", map_path)
    first, second = (begin(each, tmp_path / each.name, SECONDS) for each in (first, second))
    l2m("calibrate", second, "--bag", first, "--map", map_path, "--config", config, "--out", out)
    result = read_calibration(out / "calibration.yaml")
    assert result.bag is None
    assert {each.path for each in result.bags} == {str(first), str(second)}
    (figures,) = read_metrics(out / "metrics.json").sensors
    assert figures.drives is not None
    assert [each.bag for each in figures.drives.drives] == [each.path for each in result.bags]
    assert len(figures.drives.compared) == 2
    page = (out / "report.html").read_text()
    assert "Repeatability between drives" in page
    assert "2 drives" in page
