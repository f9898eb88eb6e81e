"""The report id: the SHA-256 of all that a result says, which its file carries and its page shows.

It is taken over content, not over bytes: JSON with sorted keys and no spaces, without the entry
``id``. Another order of keys, other line ends and comments leave it as it is; any other value, one
entry more or one less give another id.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from l2m_gtsam.errors import L2MError

ID = "id"
SHOWN = 16  # digits, where there is no room for 64


def report_id(content: Mapping[str, Any]) -> str:
    """Return the id of the plain content of a file of results, 64 hexadecimal digits.

    Parameters
    ----------
    content
        As YAML or JSON has it; an ``id`` in it does not count.
    """
    said = {key: value for key, value in content.items() if key != ID}
    try:
        text = json.dumps(said, sort_keys=True, separators=(",", ":"), default=repr)
    except (TypeError, ValueError):  # keys that are no text: not of this program
        text = repr(said)
    return hashlib.sha256(text.encode()).hexdigest()


def with_id(content: Mapping[str, Any], after: str) -> dict[str, Any]:
    """Return content with its id behind one of its entries."""
    own = {ID: report_id(content)}
    parts = ({key: value} | (own if key == after else {}) for key, value in content.items())
    return {key: value for part in parts for key, value in part.items()}


def checked_id(path: Path, content: Mapping[str, Any], error: type[L2MError]) -> str:
    """Return the id of a file's content, which is that in the file if it carries one.

    Files of earlier versions, and those that are made by hand, carry none.

    Parameters
    ----------
    path
        The file.
    content
        Its plain content.
    error
        What to raise, with one line, if the file carries the id of something else.
    """
    found = report_id(content)
    carried = content.get(ID)
    if carried not in (None, found):
        raise error(
            f"{path}: was changed after it was written: it carries the report id "
            f"{str(carried)[:SHOWN]}, what it says now has {found[:SHOWN]}; restore the file, or "
            "run the command that wrote it again"
        )
    return found
