"""Metrics and figures for people."""
