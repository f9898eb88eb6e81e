"""Honesty: whether calibrations err as much as they say, and as little as the data allow."""
