"""SLAM without a map: the field is estimated together with the poses."""
