"""SLAM with several sensors, in a map and without one, on recordings of others and simulated."""
