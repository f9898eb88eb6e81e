"""The program from Python: arrays or files in, records out."""
