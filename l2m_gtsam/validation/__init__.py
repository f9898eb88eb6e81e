"""Whether a calibration is still valid on another drive."""
