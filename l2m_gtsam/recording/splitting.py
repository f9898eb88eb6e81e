"""A drive in two parts."""

from dataclasses import replace

import numpy as np

from l2m_gtsam.data import BoolArray, IntArray, Recording


def split_at(recording: Recording, stamp_ns: int) -> tuple[Recording, Recording]:
    """Return what one drive recorded before a time in nanoseconds, and from then on."""

    def part(*, later: bool) -> Recording:
        def on(stamps: IntArray) -> BoolArray:
            return np.asarray((stamps >= stamp_ns) == later)

        poses = recording.trajectory
        return replace(
            recording,
            trajectory=poses[on(poses.stamp_ns)],
            series=tuple(each[on(each.stamp_ns)] for each in recording.series),
            scalars=tuple(each[on(each.stamp_ns)] for each in recording.scalars),
        )

    return part(later=False), part(later=True)
