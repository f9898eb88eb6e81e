"""A command that is in the middle of writing until somebody stops it."""

SLOW = """
import sys, time
from pathlib import Path
from l2m_gtsam.cli import app
from l2m_gtsam.storage.files import atomic_path

def slow(arguments, **_):
    ready = Path(arguments[0])
    with atomic_path(ready.with_name("result")) as temporary:
        temporary.write_text("half")
        ready.touch()
        time.sleep(60)  # until the signal of the test arrives

app.app = slow
app.main()
"""
