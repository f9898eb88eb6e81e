"""Bags with images and clouds: what a calibration does not need is not held, and hardly read."""

import time
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from tests.drives.large_bags import write_among_images
from tests.fuzz.corpus import make_demo
from tests.fuzz.runner import run_case

SIZE = 2_000_000_000
MOST_BYTES = 3 << 28  # beside the program, which takes 250 MB
COMPUTES_S = 20.0  # of a core: the calibration itself takes 7


@pytest.mark.study
def test_a_bag_with_images_and_clouds(tmp_path: Path) -> None:
    demo = tmp_path / "demo"
    make_demo(demo)
    bag = write_among_images(tmp_path / "large", demo / "calibration_mcap", SIZE)
    library = seconds_of_library(bag)
    looked = run_case(["inspect", str(bag)], tmp_path, tmp_path / "out")
    words = ["calibrate", str(bag), "--map", str(demo / "map.npz"), "--out", str(tmp_path / "out")]
    found = run_case(words, tmp_path, tmp_path / "out", most_s=300)
    assert (looked.how, found.how) == ("done", "done"), (looked, found)
    assert max(looked.peak_bytes, found.peak_bytes) < MOST_BYTES
    # Half the speed of the reader of bags, which passes over the same messages.
    assert looked.cpu_s < 2 * library + 2
    # The digest of the bag is a second pass.
    assert found.cpu_s < 4 * library + COMPUTES_S


def seconds_of_library(bag: Path) -> float:
    """Return the seconds of a core of a pass over the messages that are needed."""
    begun = time.process_time()
    with AnyReader([bag]) as reader:
        needed = [each for each in reader.connections if not each.topic.startswith(("/c", "/l"))]
        assert sum(1 for _ in reader.messages(needed))
    return time.process_time() - begun
