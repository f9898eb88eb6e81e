"""Sources that came, went or were moved since a place was mapped."""
