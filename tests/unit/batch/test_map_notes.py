"""What speaks against a map is told by whatever uses it: by the map itself, and by its file."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from l2m_gtsam.batch.files import SavedMap, map_notes
from l2m_gtsam.data import MapState


def test_doubts_of_a_map_and_of_what_it_was_made_with_are_notes() -> None:
    suite = {"path": "suite.yaml", "sha256": "ab", "verdict": "fail"}
    saved = SavedMap(Path("map.npz"), MapState("harmonic", {}, {}, {"suite": suite}))
    field_map: Any = SimpleNamespace(summary=SimpleNamespace(doubts=("sigmas are less sure",)))
    assert map_notes(saved, field_map) == (
        "Of the map: sigmas are less sure",
        "Of the map: it was made with suite.yaml, whose verdict is FAIL",
    )
