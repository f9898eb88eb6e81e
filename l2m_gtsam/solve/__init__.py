"""Closed forms, rank and statistics: pure functions on arrays."""
