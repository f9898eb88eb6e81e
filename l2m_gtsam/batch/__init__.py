"""Files in, files out: what the command line does, callable from Python."""
