"""Print all benchmarks: ``python scripts/benchmark.py`` from the root of a checkout."""

import runpy
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

for name in ("benchmarks.map_queries", "benchmarks.one_key"):
    runpy.run_module(name, run_name="__main__")
