"""SLAM in an unknown field: methods side by side on recordings of others."""
