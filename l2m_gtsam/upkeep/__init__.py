"""Maps kept up: what changed at a place, drive by drive."""
