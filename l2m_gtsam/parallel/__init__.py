"""Work in threads and in clusters of processes."""
