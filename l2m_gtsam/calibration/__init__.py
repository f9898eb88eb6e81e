"""From data to factor graphs and back: the calibration graph and the one-key loop."""
