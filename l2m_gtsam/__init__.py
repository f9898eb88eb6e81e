"""Calibrate magnetometers against a LiDAR from one drive through a mapped magnetic field."""
