"""Sensors in URDFs, read back with ROS' own parser."""

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from scipy.spatial.transform import Rotation
from urdf_parser_py.urdf import URDF

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.records.calibration import SensorStatus
from l2m_gtsam.storage.exports.urdf import comment_text, edited_urdf, roll_pitch_yaw, urdf_text
from tests.drives.calibrations import mounted, rotations, sensor, unsolved

ROBOT = """<?xml version="1.0" encoding="utf-8"?>
<!-- a robot -->
<robot name="cart">
  <link name="base_link"/>
  <link name="velodyne">
    <visual> <geometry> <box size="0.1 0.1 0.1"/> </geometry> </visual>  <!-- <link name="x"/> -->
  </link>
  <joint name="roof" type="fixed">
    <parent link="base_link"/> <child link="velodyne"/>
    <origin xyz="0 0 1" rpy="0 0 0"/>
  </joint>
  <link name="mag" />
  <!-- where we thought it was: > -->
  <joint type='revolute' name="mag>mount">
    <origin xyz="9 9 9" rpy="9 9 9"/> <parent link="base_link"/> <child link="mag"/>
    <axis xyz="1 0 0"/> <limit effort="1" velocity="1" lower="0" upper="1"/>
  </joint>
  <gazebo reference="mag"><material>Gazebo/Grey</material></gazebo>
  <transmission name="t">
    <type>transmission_interface/SimpleTransmission</type>
    <joint name="mag>mount"><hardwareInterface>none</hardwareInterface></joint>
    <actuator name="a"/>
  </transmission>
</robot>
<!-- the end -->
"""


def joint_of(robot: Any, link: str) -> Any:
    (joint,) = (each for each in robot.joints if each.child == link)
    return joint


def origin(joint: Any) -> tuple[Rotation, FloatArray]:
    """Return a joint's origin: fixed axes x, y, z in this order, as the URDF standard says."""
    return Rotation.from_euler("xyz", joint.origin.rpy), np.array(joint.origin.xyz)


@given(rotations())
def test_a_urdf_of_its_own(R: FloatArray) -> None:
    text = urdf_text(mounted([sensor("imu/mag", R), sensor("other", R.T)], "velodyne"))
    robot = URDF.from_xml_string(text.encode())
    assert [link.name for link in robot.links] == ["velodyne", "imu/mag", "other"]
    for name, turn in (("imu/mag", R), ("other", R.T)):
        joint = joint_of(robot, name)
        assert (joint.type, joint.parent) == ("fixed", "velodyne")
        found, place = origin(joint)
        # Angles of up to pi in double precision.
        np.testing.assert_allclose(found.as_matrix(), turn.T, rtol=0, atol=3e-15)
        np.testing.assert_array_equal(place, [0.31, -0.12, 0.05])


@given(rotations())
def test_angles_compose_to_the_rotation(R: FloatArray) -> None:
    """Also where two of them turn about the same axis."""
    found = Rotation.from_euler("xyz", roll_pitch_yaw(R)).as_matrix()
    np.testing.assert_allclose(found, R, rtol=0, atol=3e-15)


def test_a_robot_gets_its_sensors() -> None:
    R = Rotation.from_euler("xyz", [0.1, -0.7, 2.0]).as_matrix()
    export = mounted([sensor("mag", R), sensor("new/mag", R)], "velodyne")
    edited = edited_urdf(export, "cart.urdf", ROBOT.encode())
    robot = URDF.from_xml_string(edited)
    assert [j.name for j in robot.joints] == ["roof", "mag>mount", "velodyne_to_new/mag"]
    for name in ("mag", "new/mag"):
        joint = joint_of(robot, name)
        assert (joint.type, joint.parent) == ("fixed", "velodyne")
        np.testing.assert_allclose(origin(joint)[0].as_matrix(), R.T, rtol=0, atol=3e-15)
    assert [link.name for link in robot.links] == ["base_link", "velodyne", "mag", "new/mag"]


def test_everything_else_stays_as_it_stands() -> None:
    """Without the joint that was replaced and the lines that were added, it is the same file."""
    export = mounted([sensor("mag"), sensor("new")], "velodyne")
    edited = edited_urdf(export, "cart.urdf", ROBOT.encode()).decode()
    joint = re.compile(r"<joint [^<]*name=\"mag(>|&gt;)mount\".*?</joint>", re.DOTALL)
    assert joint.sub("", ROBOT, count=1) == re.sub(
        r"  <link name=\"new\"/>\n.*?-->\n(?=</robot>)",
        "",
        joint.sub("", edited, count=1),
        flags=re.DOTALL,
    )
    assert edited_urdf(export, "cart.urdf", edited.encode()).decode() == edited


@pytest.mark.parametrize(
    "robot",
    [
        '<robot name="r"><link name="lidar"/></robot>',
        '<robot name="r"><link name="lidar"/><link name="mag"/></robot>',
        (
            '<robot name="r"><link name="lidar"/><link name="mag"/><joint name="j" type="fixed">'
            '<parent link="lidar"/><child link="mag"/></joint></robot>'
        ),
        (
            '\ufeff<robot name="\u00e9"><link name="lidar"/><link name="mag"/>'
            '<joint name="lidar_to_mag" type="fixed"><parent link="lidar"/><child link="other"/>'
            "</joint>\r\n\t</robot>\r\n"
        ),
    ],
)
def test_any_layout_is_edited(robot: str) -> None:
    export = mounted([sensor("mag", Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix())])
    data = robot.encode()
    edited = edited_urdf(export, "r.urdf", data)
    read = URDF.from_xml_string(edited)
    np.testing.assert_allclose(
        origin(joint_of(read, "mag"))[0].as_rotvec(), [-0.3, -0.2, -0.1], rtol=0, atol=1e-15
    )
    assert len({joint.name for joint in read.joints}) == len(read.joints)
    assert (b"\r\n" in edited) == (b"\r\n" in data)
    assert edited.count(b"\n") == edited.count(b"\r\n") or b"\r\n" not in data


def test_a_stranger_in_a_name_is_escaped() -> None:
    name = "a'b\"<c>&d"
    robot = URDF.from_xml_string(urdf_text(mounted([sensor(name)])).encode())
    assert robot.joints[0].child == name


@pytest.mark.parametrize("line", ["--", "a---b-", "-->", "drive: north -- 2.bag"])
def test_a_comment_ends_where_it_should(line: str) -> None:
    assert "--" not in comment_text(line)
    bad = unsolved("n", SensorStatus.NO_READINGS, line)
    URDF.from_xml_string(urdf_text(mounted([sensor("m"), bad])).encode())


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        ('<robot name="r"><link name="base"/></robot>', "no link 'lidar' for the LiDAR; name it"),
        ("<robot><link name='lidar'></robot>", "not valid XML: mismatched tag"),
        ("<sdf/>", "not a URDF: its root is <sdf>"),
        ("", "not valid XML: no element found"),
        (
            '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><robot>&b;</robot>',
            "has a document type definition",
        ),
        (
            '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot>&x;</robot>',
            "has a document type definition",
        ),
        (
            '<robot xmlns:xacro="http://x"><link name="lidar"/><xacro:sensor/></robot>',
            "is a xacro file; run `xacro` on it first",
        ),
        ('<?xml version="1.0" encoding="ISO-8859-1"?><robot/>', "its encoding is ISO-8859-1"),
        (
            (
                '<robot><link name="mag"/><link name="lidar"/><joint name="j" type="fixed">'
                '<parent link="mag"/><child link="lidar"/></joint></robot>'
            ),
            "link 'lidar' of the LiDAR hangs below the sensor's link 'mag'",
        ),
        (
            (
                '<robot><link name="lidar"/><link name="mag"/>'
                '<joint name="a" type="fixed"><parent link="lidar"/><child link="mag"/></joint>'
                '<joint name="b" type="fixed"><parent link="lidar"/><child link="mag"/></joint>'
                "</robot>"
            ),
            "link 'mag' hangs below two joints; remove one",
        ),
    ],
)
def test_what_is_no_robot_is_refused(robot: str, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        edited_urdf(mounted([sensor("mag")]), "r.urdf", robot.encode())
    assert str(error.value).startswith("r.urdf: ")
    assert message in str(error.value)


def test_another_encoding_is_refused() -> None:
    with pytest.raises(ConfigError, match="is not text in UTF-8"):
        edited_urdf(mounted([sensor("mag")]), "r.urdf", ROBOT.encode("utf-16"))
