"""From recordings of a mapping suite to a map."""
