"""What flows through the program: frozen records of arrays, with shapes and units.

Frames: ``map``, ``lidar``, ``mag`` (one per sensor). ``T_map_lidar`` maps a point given in the
lidar frame to the map frame. Positions are in metres, magnetic field in microtesla, stamps in
integer nanoseconds.
"""

from l2m_gtsam.data.arrays import (
    BoolArray,
    FieldAndGradient,
    FloatArray,
    InFile,
    IntArray,
    Matrix,
    Row3,
    Vector,
)
from l2m_gtsam.data.field_sample import FieldSample
from l2m_gtsam.data.map_state import LidarMap, MapState
from l2m_gtsam.data.poses import RigidTransform, Trajectory
from l2m_gtsam.data.readings import LidarMotion, Readings, SaturatedAxis, SyncCounts, Synchronised
from l2m_gtsam.data.recording import (
    ARRAYS,
    FieldSeries,
    Recording,
    ScalarSeries,
    SourceFile,
    same_content,
)
from l2m_gtsam.data.sensor import CorrectedField, Distortion, KnownSensor
from l2m_gtsam.data.tables import RowTable, TimedTable, chosen_rows, joined_rows

__all__ = [
    "ARRAYS",
    "BoolArray",
    "CorrectedField",
    "Distortion",
    "FieldAndGradient",
    "FieldSample",
    "FieldSeries",
    "FloatArray",
    "InFile",
    "IntArray",
    "KnownSensor",
    "LidarMap",
    "LidarMotion",
    "MapState",
    "Matrix",
    "Readings",
    "Recording",
    "RigidTransform",
    "Row3",
    "RowTable",
    "SaturatedAxis",
    "ScalarSeries",
    "SourceFile",
    "SyncCounts",
    "Synchronised",
    "TimedTable",
    "Trajectory",
    "Vector",
    "chosen_rows",
    "joined_rows",
    "same_content",
]
