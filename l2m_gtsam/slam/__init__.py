"""Poses as unknowns: localisation in a magnetic map."""
