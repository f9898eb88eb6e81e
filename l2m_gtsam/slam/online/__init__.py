"""A drive localised in a map, key pose by key pose."""
