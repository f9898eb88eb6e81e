"""The documentation names what exists: every path, every dotted name, every level."""

import importlib
import re
import tomllib
from pathlib import Path

import pytest

import l2m_factors
from tests.support.repository import REPOSITORY

DOCS = REPOSITORY / "docs"
TOP = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "factors/README.md")
PAGES = [
    *(REPOSITORY / each for each in TOP),
    *sorted(DOCS.rglob("*.md")),
]
LEAST = {"architecture.md": 100, "glossary.md": 50}
"""Names on the pages on the code: fewer would test nothing."""
CODE = re.compile(r"`([^`\n]+)`")
DOTTED = re.compile(r"(l2m_gtsam|l2m_factors)(\.\w+)+")
FACTOR = re.compile(r"[A-Z][a-z]+[A-Z]\w+|[a-z_]+_(factor|prior|information)")
FOLDERS = ("l2m_gtsam/", "factors/", "tests/", "docs/")
LOOP = 14  # files from `calibrate` to the marginals, at most


def named(page: Path) -> list[str]:
    """Return the paths and dotted names of a page."""
    codes = CODE.findall(page.read_text(encoding="utf-8"))
    return [each for each in codes if is_path(each) or DOTTED.fullmatch(each)]


def is_path(text: str) -> bool:
    return text.startswith(FOLDERS)


def exists(name: str) -> bool:
    """Whether a path of the repository, a module, or something in a module has this name."""
    if is_path(name):
        return (REPOSITORY / name).exists()
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        return all_there(found, parts[end:])
    return False


def all_there(found: object, attributes: list[str]) -> bool:
    """Whether each is an attribute of the one before; the last may be a field without default."""
    for name in attributes:
        if name in getattr(found, "__annotations__", {}):
            return name == attributes[-1]
        if not hasattr(found, name):
            return False
        found = getattr(found, name)
    return True


def section(page: str, heading: str) -> str:
    """Return the text under a heading of a page."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.split(r"\n##+ ", text.partition(f"## {heading}\n")[2])[0]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(REPOSITORY).as_posix())
def test_names_exist(page: Path) -> None:
    names = named(page)
    assert len(names) >= LEAST.get(page.name, 0)
    assert [each for each in names if not exists(each)] == []


def test_the_factors_page_names_what_is_there() -> None:
    codes = CODE.findall((REPOSITORY / "factors" / "README.md").read_text(encoding="utf-8"))
    names = [each for each in codes if FACTOR.fullmatch(each)]
    assert len(names) >= 15
    assert [each for each in names if not hasattr(l2m_factors, each)] == []


def test_files_are_named_by_their_whole_path() -> None:
    """Else the test above would not see them."""
    for page in LEAST:
        codes = CODE.findall((DOCS / page).read_text(encoding="utf-8"))
        assert [each for each in codes if each.endswith(".py") and not is_path(each)] == []


def test_levels_are_those_of_the_import_rules() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))
    (rule,) = (c for c in project["tool"]["importlinter"]["contracts"] if c["type"] == "layers")
    layers = [sorted(layer.split(" | ")) for layer in rule["layers"]]
    rows = [line.split("|") for line in section("architecture.md", "Levels").splitlines()]
    stated = [
        sorted(CODE.findall(row[2])) for row in rows if len(row) > 3 and row[1].strip().isdigit()
    ]
    assert stated == layers


def test_the_loop_is_read_in_few_files() -> None:
    files = [
        each
        for each in CODE.findall(section("architecture.md", "The one-key loop"))
        if is_path(each)
    ]
    assert 0 < len(files) <= LOOP
    assert len(set(files)) == len(files)


def test_a_name_that_does_not_exist_is_noticed() -> None:
    for name in ("l2m_gtsam/nothing.py", "l2m_gtsam.nothing", "l2m_gtsam.data.Nothing"):
        assert not exists(name)
    assert exists("l2m_gtsam.records.metrics.FitFigures.rms")
