"""From a recording to readings with poses: times, joining, odometry faults, pose noise."""
