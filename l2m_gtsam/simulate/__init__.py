"""Seeded worlds, vehicles and sensors, written as real bags."""
