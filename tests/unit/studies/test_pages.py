"""Pages of studies: templates, and the pages in the documentation."""

from pathlib import Path

import pytest

from l2m_gtsam.studies.registry import STUDIES
from l2m_gtsam.studies.run import STUDY_FILE, read_study, whole_page
from l2m_gtsam.studies.study import table, unwrapped


@pytest.mark.parametrize("name", STUDIES)
def test_pages_of_the_documentation_are_those_of_their_files(repository: Path, name: str) -> None:
    """Byte by byte: whoever changes a template renders the page again."""
    study, folder = STUDIES[name], repository / "docs" / "studies" / name
    page = (folder / f"{name}.md").read_text(encoding="utf-8")
    assert whole_page(study, read_study(study, folder / STUDY_FILE)) == page


def test_paragraphs_items_and_rows_are_lines() -> None:
    text = "One\ntwo\n\n\n## Heading\n- item\n  goes on\n- next\n\n| a |\n b |\n|---|---|\n"
    assert (
        unwrapped(text) == "One two\n\n## Heading\n- item goes on\n- next\n\n| a | b |\n|---|---|"
    )


def test_a_table_has_a_rule_under_its_titles() -> None:
    rows = ("1", "2"), ("3", "4")
    assert table(["a", "b"], rows) == "| a | b |\n|---|---|\n| 1 | 2 |\n| 3 | 4 |"
