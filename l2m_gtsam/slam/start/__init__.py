"""The start of a drive that is not known, searched for in the map."""
