"""Print all benchmarks: ``python scripts/benchmark.py`` from the root of a checkout."""

import runpy
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # benchmarks and tests are no part of the installed package

for path in sorted((ROOT / "benchmarks").glob("*.py")):
    runpy.run_module(f"benchmarks.{path.stem}", run_name="__main__")
