"""The report: figures and pages from a calibration and its metrics."""
