"""What takes a second each and is looked at in other tests, left out where it is not looked at."""

from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from l2m_gtsam.batch import drives, reports, validation
from l2m_gtsam.qa.report import localisation_page
from l2m_gtsam.storage.yaml_file import BoundedYAML


@contextmanager
def no_pages() -> Iterator[None]:
    """Draw no pages and pictures: their files are there, and empty."""

    def empty(*_: object) -> str:
        return ""

    def touched(_: object, path: Path) -> None:
        path.touch()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reports, "calibration_page", empty)
        patch.setattr(localisation_page, "localisation_page", empty)
        patch.setattr(validation, "validation_page", empty)
        patch.setattr(drives, "save_figure", touched)
        yield


@contextmanager
def texts_parsed_once() -> Iterator[None]:
    """Parse a text of YAML that several commands read for the first of them."""
    parsed, parse = dict[str, Any](), BoundedYAML.load

    def load(reader: BoundedYAML, stream: Any) -> Any:
        if not isinstance(stream, str):
            return parse(reader, stream)
        if stream not in parsed:
            parsed[stream] = parse(reader, stream)
        return deepcopy(parsed[stream])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BoundedYAML, "load", load)
        yield
