"""A ROS 2 launch file that publishes the sensors' places on tf."""

from scipy.spatial.transform import Rotation

from l2m_gtsam.storage.exports.export import Export, ExportedSensor

HEAD = '''

from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    """Publish where every calibrated magnetometer sits in the frame of the LiDAR."""
    return LaunchDescription(
        [
'''
TAIL = """        ]
    )
"""


def launch_text(export: Export) -> str:
    """Return a Python launch file with a static transform publisher for each sensor.

    Metres and quaternions x, y, z, w of ``T_lidar_mag``, which turns a point given in the sensor's
    frame into the lidar's: parent is the lidar, child the sensor.
    """
    comments = (*export.origin, "The parent of every transform is the LiDAR, the child a sensor.")
    top = "\n".join(f"# {line}" for line in comments)
    nodes = "".join(_node(sensor, export.lidar_frame) for sensor in export.sensors)
    return top + HEAD + nodes + TAIL


def _node(sensor: ExportedSensor, lidar_frame: str) -> str:
    """Return the node of one sensor; the program itself gives it a name that is not taken."""
    arguments = "".join(
        f"                    {name!r}, {value!r},\n"
        for name, value in _arguments(sensor, lidar_frame).items()
    )
    return f"""            Node(
                package='tf2_ros',
                executable='static_transform_publisher',
                arguments=[
{arguments}                ],
            ),
"""


def _arguments(sensor: ExportedSensor, lidar_frame: str) -> dict[str, str]:
    transform = sensor.T_lidar_mag
    numbers = [*transform.t, *Rotation.from_matrix(transform.R).as_quat(canonical=True)]
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    values = {name: repr(float(number)) for name, number in zip(names, numbers, strict=True)}
    return {**values, "--frame-id": lidar_frame, "--child-frame-id": sensor.frame}
