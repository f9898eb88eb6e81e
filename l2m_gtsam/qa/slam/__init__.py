"""A localisation in figures and words."""
