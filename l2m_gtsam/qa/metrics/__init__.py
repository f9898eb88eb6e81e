"""Figures of a calibration: arrays in, plain records out."""
