"""The error budget of a drive: processes that are found in what sensors, map and poses leave."""
