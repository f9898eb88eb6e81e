"""The report id: any other value is another id, and a file that carries one is held to it."""

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.storage.calibration_file import (
    HEADER,
    calibration_content,
    calibration_in,
    read_calibration,
    write_calibration,
)
from l2m_gtsam.storage.known_sensors import read_known_sensors
from l2m_gtsam.storage.record_files import read_slam, record_id, write_slam
from l2m_gtsam.storage.report_id import ID, checked_id, report_id
from l2m_gtsam.storage.yaml_file import BoundedYAML, read_yaml, write_yaml, yaml_text

FILES = Path(__file__).parents[2] / "files"
CHANGED = "was changed after it was written"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("written") / "calibration.yaml"
    write_calibration(path, read_calibration(FILES / "calibration.yaml"))
    return path


@pytest.fixture(scope="module")
def content(written: Path) -> dict[str, Any]:
    found = read_yaml(written, CalibrationError)
    assert isinstance(found, dict)
    return found


def leaves(content: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Return the keys that lead to each value."""
    if isinstance(content, dict | list) and content:
        items = content.items() if isinstance(content, dict) else enumerate(content)
        for key, value in items:
            yield from leaves(value, (*way, key))
    else:
        yield way


def changed(value: Any) -> Any:
    """Return another value of the same kind, a number by its last digits."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return 1.5 if value != value or abs(value) == float("inf") else value * (1 + 1e-14) + 1e-300
    return f"{value}." if isinstance(value, str) else "something"


def tampered(content: dict[str, Any], way: tuple[Any, ...]) -> dict[str, Any]:
    """Return content with another value at a place."""
    other = copy.deepcopy(content)
    inner: Any = other
    for key in way[:-1]:
        inner = inner[key]
    inner[way[-1]] = changed(inner[way[-1]])
    return other


def test_each_value_of_the_file_counts(content: dict[str, Any]) -> None:
    """Of some hundred places, those that other entries repeat among them."""
    ways = [way for way in leaves(content) if way != (ID,)]
    sensor = next(iter(content["sensors"]))
    for entry in ("t_lidar_mag", "t_sigma", "C", "transforms", "covariance"):
        assert any(way[:3] == ("sensors", sensor, entry) for way in ways)
    same = [way for way in ways if report_id(tampered(content, way)) == content[ID]]
    assert len(ways) > 500
    assert same == []


@settings(max_examples=12, deadline=None)
@given(data=st.data())
def test_a_changed_file_is_refused(
    data: st.DataObject, written: Path, content: dict[str, Any]
) -> None:
    """Wherever it is changed; what can no longer be read is refused for that."""
    way = data.draw(st.sampled_from([way for way in leaves(content) if way != (ID,)]))
    with pytest.raises(CalibrationError):
        calibration_in(written.parent / "alone.yaml", tampered(content, way))


@pytest.mark.parametrize("way", [("t_lidar_mag", 0), ("t_sigma", 1), ("C", 0, 0), ("H_sigma", 2)])
def test_the_line_says_so(tmp_path: Path, content: dict[str, Any], way: tuple[Any, ...]) -> None:
    """Of numbers that are sound, in every reader."""
    sensor = next(iter(content["sensors"]))
    path = tmp_path / "alone.yaml"
    write_yaml(path, tampered(content, ("sensors", sensor, *way)), "")
    for reader in (read_calibration, read_known_sensors):
        with pytest.raises(CalibrationError, match=CHANGED) as told:
            reader(path)
        assert str(content[ID])[:16] in str(told.value)
        assert "\n" not in str(told.value)


def test_form_does_not_count(tmp_path: Path, content: dict[str, Any]) -> None:
    """Order of keys, ends of lines and comments may be others."""
    path = tmp_path / "other.yaml"
    text = yaml_text(dict(reversed(content.items())), "Another comment.")
    path.write_bytes(text.replace("\n", "\r\n").encode())
    assert read_calibration(path).report_id == content[ID]


def test_a_file_without_an_id_is_read(tmp_path: Path, content: dict[str, Any]) -> None:
    """One of an earlier version, or made by hand; it has an id all the same."""
    old = read_calibration(FILES / "calibration.yaml")
    assert len(old.report_id) == 64
    without = {key: value for key, value in content.items() if key != ID}
    sensor = next(iter(content["sensors"]))
    path = tmp_path / "by_hand.yaml"
    write_yaml(path, tampered(without, ("sensors", sensor, "t_lidar_mag", 0)), HEADER)
    assert read_calibration(path).report_id != content[ID]


def test_what_is_written_has_the_id_of_its_record(written: Path, content: dict[str, Any]) -> None:
    result = read_calibration(written)
    assert result.report_id == content[ID] == calibration_content(result)[ID]
    assert write_calibration(written, result).report_id == content[ID]


TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
# A plain key that begins with a colon is written and cannot be read: no file of ours has one.
KEY = TEXT.filter(lambda key: key != ID and not key.startswith(":"))
LEAF = st.none() | st.booleans() | st.integers() | st.floats() | TEXT | st.sampled_from("?b \x85")


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(KEY, LEAF | st.lists(LEAF, max_size=3)))
def test_the_id_survives_a_file(content: dict[str, Any]) -> None:
    """No text and no number is read as another than was written."""
    assert report_id(BoundedYAML().load(yaml_text(content, ""))) == report_id(content)


def test_keys_that_are_no_text_do_not_matter() -> None:
    """A file of a stranger may hold anything."""
    odd: Any = {"a": 1, 2: "b", None: {1: 2, "x": 3}}
    with pytest.raises(CalibrationError, match=CHANGED):
        checked_id(Path("odd.yaml"), {**odd, ID: "1" * 64}, CalibrationError)


def test_a_localisation_carries_one_too(tmp_path: Path) -> None:
    path = tmp_path / "slam.json"
    written = write_slam(path, read_slam(FILES / "slam.json"))
    plain = json.loads(path.read_text())
    assert plain[ID] == written == record_id(path)
    plain["steps"] *= 1.0001
    path.write_text(json.dumps(plain))
    with pytest.raises(CalibrationError, match=CHANGED):
        read_slam(path)
    del plain[ID]
    path.write_text(json.dumps(plain))
    assert read_slam(path).steps == plain["steps"]
