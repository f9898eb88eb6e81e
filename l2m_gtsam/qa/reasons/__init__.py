"""Reasons of a verdict: what speaks for and against a calibration, one sentence each."""
