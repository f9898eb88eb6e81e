"""Numbers out of bags that go along with a drive."""

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from rosbags.rosbag2 import Writer
from rosbags.typesys import get_types_from_msg

from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.bag_options import BagOptions, RegressorTopic, Stamps
from l2m_gtsam.storage.regressors import read_scalars
from tests.drives.bags import KINDS, Entry, Ros, ros, write
from tests.support.memory import with_peak

START = 1_700_000_000_000_000_000
STEP = 50_000_000
LATE = 7_000_000  # a bag receives a message so long after its stamp


def odometry(make: Ros, stamp_ns: int, speed: float) -> Any:
    pose = make(
        "geometry_msgs/PoseWithCovariance",
        pose=make.pose([0, 0, 0], [0, 0, 0, 1]),
        covariance=np.zeros(36),
    )
    twist = make(
        "geometry_msgs/TwistWithCovariance",
        twist=make(
            "geometry_msgs/Twist", linear=make.vector([speed, 0, 0]), angular=make.vector([0, 0, 1])
        ),
        covariance=np.zeros(36),
    )
    return make(
        "nav_msgs/Odometry",
        header=make.header(stamp_ns, "odom"),
        child_frame_id="base",
        pose=pose,
        twist=twist,
    )


def duties(make: Ros, values: list[float]) -> Any:
    layout = make("std_msgs/MultiArrayLayout", dim=[], data_offset=0)
    return make("std_msgs/Float64MultiArray", layout=layout, data=np.array(values, dtype=float))


def entries(kind: str, count: int = 20, stamp: int = START) -> list[Entry]:
    """A current, a speed, duty cycles, a switch and a name at 20 Hz."""
    make, found = ros(kind), []
    for k in range(count):
        header, record = stamp + k * STEP * (stamp > 0), START + k * STEP + LATE
        message = {
            "/motor/current": ("std_msgs/Float64", make("std_msgs/Float64", data=0.5 * k)),
            "/odom": ("nav_msgs/Odometry", odometry(make, header, 0.1 * k)),
            "/duty": ("std_msgs/Float64MultiArray", duties(make, [k, 2 * k, 3 * k])),
            "/lamp": ("std_msgs/Bool", make("std_msgs/Bool", data=k % 2 == 0)),
            "/name": ("std_msgs/String", make("std_msgs/String", data="robot")),
        }
        found += [Entry(topic, kind, record, each) for topic, (kind, each) in message.items()]
    return found


ASKED = {
    "current": RegressorTopic(topic="/motor/current", scale=2.0),
    "speed": RegressorTopic(topic="odom", field="twist.twist.linear.x"),
    "duty": RegressorTopic(topic="/duty", field="data[2]"),
    "duty_0": RegressorTopic(topic="/duty", field="data[0]"),
    "lamp": RegressorTopic(topic="/lamp"),
}


def only(name: str, **topic: Any) -> BagOptions:
    return BagOptions(regressors={name: RegressorTopic(**topic)})


@pytest.mark.parametrize("kind", KINDS)
def test_numbers_of_any_type_are_read_in_one_pass(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path, kind, entries(kind))
    current, speed, duty, duty_0, lamp = read_scalars(path, BagOptions(regressors=ASKED))
    k = np.arange(20)
    assert [current.name, duty_0.name, speed.topic] == ["current", "duty_0", "odom"]
    np.testing.assert_array_equal(current.stamp_ns, START + k * STEP + LATE)  # it has no header
    np.testing.assert_array_equal(speed.stamp_ns, START + k * STEP)
    np.testing.assert_array_equal(current.value, 1.0 * k)
    np.testing.assert_array_equal(speed.value, 0.1 * k)
    np.testing.assert_array_equal(duty.value, 3.0 * k)
    np.testing.assert_array_equal(duty_0.value, k)
    np.testing.assert_array_equal(lamp.value, k % 2 == 0)


def test_record_time_by_option(tmp_path: Path) -> None:
    path = write(tmp_path, "mcap", entries("mcap", stamp=0))
    asked = {"speed": ASKED["speed"]}
    with pytest.raises(BagError, match=r"'speed': .*stamps are 0.*`bag.stamps: record`"):
        read_scalars(path, BagOptions(regressors=asked))
    recorded = BagOptions(regressors=asked, stamps=Stamps.RECORD)
    (speed,) = read_scalars(path, recorded)
    np.testing.assert_array_equal(speed.stamp_ns, START + np.arange(20) * STEP + LATE)


def test_what_is_not_finite_is_dropped_and_order_does_not_matter(tmp_path: Path) -> None:
    make = ros("mcap")
    content = [(3, 1.0), (1, np.nan), (1, 5.0), (1, 6.0), (2, np.inf), (0, -2.0)]
    found = [
        Entry("/odom", "nav_msgs/Odometry", START + i, odometry(make, START + k * STEP, value))
        for i, (k, value) in enumerate(content)
    ]
    path = write(tmp_path, "mcap", found)
    (speed,) = read_scalars(path, BagOptions(regressors={"speed": ASKED["speed"]}))
    np.testing.assert_array_equal(speed.stamp_ns, START + np.array([0, 1, 3]) * STEP)
    np.testing.assert_array_equal(speed.value, [-2.0, 5.0, 1.0])


FAULTS = {
    "topic": ("/motor", "data", r"no topic '/motor'; there are: /duty \(.*Float64MultiArray"),
    "field": ("/odom", "twist.linear.x", r"no 'twist.linear.x': 'twist' has the fields twist, cov"),
    "first": ("/odom", "data", r"no 'data': it has the fields header, child_frame_id, pose, twist"),
    "beyond": ("/motor/current", "data.x", r"no 'data.x': 'data' is a single number"),
    "array": ("/duty", "data", r"no number in 'data': it has 3 elements, of which \[0\]"),
    "index": ("/duty", "data[3]", r"no 'data\[3\]': 'data' has 3 elements"),
    "no array": ("/motor/current", "data[0]", r"no 'data\[0\]': 'data' is a single number"),
    "text": ("/name", "data", r"no number in 'data': it is a text"),
    "message": ("/odom", "pose", r"no number in 'pose': it has the fields pose, covariance"),
    # What Python gives to arrays and texts is no field of a message.
    "size": ("/duty", "data.size", r"no 'data.size': 'data' has 3 elements"),
    "upper": ("/name", "data.upper", r"no 'data.upper': 'data' is a text"),
}


@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_one_line(tmp_path: Path, kind: str, name: str) -> None:
    topic, field, expected = FAULTS[name]
    path = write(tmp_path, kind, entries(kind, 2))
    with pytest.raises(BagError, match=expected) as error:
        read_scalars(path, only("motor", topic=topic, field=field))
    assert str(error.value).startswith(f"{path}: regressor 'motor': ")
    assert "\n" not in str(error.value)


def test_constants_of_a_type_are_no_numbers_of_a_message(tmp_path: Path) -> None:
    make = ros("mcap")
    status = make.store.types["sensor_msgs/msg/NavSatStatus"]
    message = status(status=0, service=1)
    path = write(tmp_path, "mcap", [Entry("/gps", "sensor_msgs/NavSatStatus", START, message)])
    for field in ("STATUS_FIX", "status.real"):
        with pytest.raises(BagError, match=rf"no '{field}'"):
            read_scalars(path, only("fix", topic="/gps", field=field))
    (found,) = read_scalars(path, only("fix", topic="/gps", field="service"))
    assert found.value == [1.0]


def test_silent_and_senseless_topics(tmp_path: Path) -> None:
    make = ros("mcap")
    nothing = make("std_msgs/Float64", data=np.nan)
    path = write(tmp_path, "mcap", [Entry("/motor", "std_msgs/Float64", START, nothing)])
    with pytest.raises(BagError, match="topic /motor has no finite 'data'"):
        read_scalars(path, only("motor", topic="/motor"))
    assert read_scalars(path, BagOptions()) == ()


def test_types_of_ones_own_need_a_definition_in_the_bag(tmp_path: Path) -> None:
    make = ros("sqlite3")
    make.store.register(get_types_from_msg("float64 current", "drive_msgs/msg/Motor"))
    path = tmp_path / "bag"
    with Writer(path, version=9) as writer:
        to = writer.add_connection("/motor", "drive_msgs/msg/Motor", typestore=make.store)
        message = make("drive_msgs/Motor", current=3.0)
        writer.write(to, START, make.store.serialize_cdr(message, "drive_msgs/msg/Motor"))
    asked = {"motor": RegressorTopic(topic="/motor", field="current")}
    assert read_scalars(path, BagOptions(regressors=asked))[0].value == [3.0]
    with closing(sqlite3.connect(next(path.glob("*.db3")))) as database:
        database.execute("DELETE FROM message_definitions")
        database.commit()
    with pytest.raises(BagError, match=r"drive_msgs/msg/Motor on /motor .*the bag holds none"):
        read_scalars(path, BagOptions(regressors=asked))


@pytest.mark.parametrize(
    "field",
    [
        *("", ".", "data.", "__class__", "data.__len__", "data[-1]", "data[x]", "a b", "data()"),
        *("é", "x" * 101, ".".join("a" * 21), "data[0][1]", "data[1234567]", "data\n"),
    ],
)
def test_paths_that_are_none_are_refused(field: str) -> None:
    with pytest.raises(ValidationError):
        RegressorTopic(topic="/motor", field=field)


@pytest.mark.parametrize("scale", [0.0, float("nan"), float("inf")])
def test_scales_that_leave_nothing_are_refused(scale: float) -> None:
    with pytest.raises(ValidationError):
        RegressorTopic(topic="/motor", scale=scale)


def test_memory_does_not_grow_with_what_is_not_asked_for(tmp_path: Path) -> None:
    """24 MB of duty cycles beside one of which the first is read: one message at a time."""
    make = ros("mcap")
    big = duties(make, [1.0] * 100_000)
    found = [Entry("/big", "std_msgs/Float64MultiArray", START + k, big) for k in range(30)]
    path = write(tmp_path, "mcap", found)
    first_only = only("first", topic="/big", field="data[0]")
    (first,), peak = with_peak(lambda: read_scalars(path, first_only))
    assert len(first) == 30
    assert peak < 8e6
