"""The scaling study: time and memory against readings, sensors, maps and workers."""
