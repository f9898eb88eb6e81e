"""Print all benchmarks: ``python scripts/benchmark.py`` from the root of a checkout."""

import runpy
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

MODULES = (
    "map_queries",
    "harmonic_build",
    "compiled_map",
    "global_start",
    "one_key",
    "map_uncertainty",
    "last_stage",
    "error_budget",
    "online_localisation",
    "online_exploring",
    "slam_engine",
)

for name in MODULES:
    runpy.run_module(f"benchmarks.{name}", run_name="__main__")
