"""What a drive will determine, before it is calibrated."""
