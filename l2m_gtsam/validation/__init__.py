"""Whether a calibration still holds on another drive."""
