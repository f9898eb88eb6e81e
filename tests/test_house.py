"""The order of the code and of the tests: names, folders, and what tests import."""

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

SHARED = ("worlds", "drives", "support", "reference", "fuzz")
"""Folders of ``tests`` that tests and benchmarks may import from."""


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what is within a piece of code but for expressions: they import and define nothing."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.expr):
            yield child
            yield from statements(child)


def imported(file: Path) -> Iterator[str]:
    """Yield the modules that a file imports, and what it imports from them as if modules."""
    for node in statements(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.module is not None, f"{file}:{node.lineno}: a relative import"
            yield node.module
            yield from (f"{node.module}.{name.name}" for name in node.names)


@pytest.mark.parametrize("folder", ["tests", "benchmarks"])
def test_no_test_imports_another(repository: Path, folder: str) -> None:
    """What several tests need stands in a shared folder; conftest.py is for pytest alone."""
    wrong = [
        f"{file.relative_to(repository)} imports {module}"
        for file in sorted((repository / folder).rglob("*.py"))
        if "node_modules" not in file.parts
        for module in imported(file)
        if module.startswith("tests.") and module.split(".")[1] not in SHARED
    ]
    assert not wrong, "\n".join(wrong)


def test_shared_folders_hold_no_tests(repository: Path) -> None:
    found = [file for each in SHARED for file in (repository / "tests" / each).rglob("test_*.py")]
    assert not found


@pytest.mark.parametrize("kind", ["unit", "integration"])
def test_folders_of_tests_are_packages_of_the_library(repository: Path, kind: str) -> None:
    """And a file beside them tests the module of its name."""
    library = repository / "l2m_gtsam"
    entries = [e for e in (repository / "tests" / kind).iterdir() if not e.name.startswith("__")]
    tested = {e: library / e.name.removeprefix("test_") for e in entries}
    wrong = [e for e, of in tested.items() if not (of.is_file() or (of / "__init__.py").is_file())]
    assert not wrong


def test_no_class_name_stands_for_two_things(repository: Path) -> None:
    defined: dict[str, list[str]] = defaultdict(list)
    for folder in ("l2m_gtsam", "factors", "scripts"):
        for file in sorted((repository / folder).rglob("*.py")):
            for node in statements(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    defined[node.name].append(f"{file.relative_to(repository)}:{node.lineno}")
    assert len(defined) > 100
    assert not {name: places for name, places in defined.items() if len(places) > 1}


def test_few_modules_lie_outside_of_packages(repository: Path) -> None:
    """What belongs to a topic is in its package: the root has what all packages share."""
    modules = {file.stem for file in (repository / "l2m_gtsam").glob("*.py")} - {"__init__"}
    assert modules == {"config", "errors", "geometry", "options", "progress"}
