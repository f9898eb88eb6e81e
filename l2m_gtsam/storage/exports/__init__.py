"""Calibrations in the formats of other programs."""
