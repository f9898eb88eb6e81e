"""Poses from scans: odometry, localisation on a cloud, loops. Scans in, poses out; no files."""
