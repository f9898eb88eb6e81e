"""Pages of the documentation as code: the blocks of a page, and what runs them."""

import contextlib
import io
import re
import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from l2m_gtsam.cli import main
from l2m_gtsam.config import Config
from l2m_gtsam.options import Options
from l2m_gtsam.simulate.scenario import ScenarioOptions

FENCE = re.compile(r"^( *)```(.*)$")
NOT_RUN = re.compile(r"^ *<!-- not run: (.+) -->$")
PLAIN = re.compile(r"^ *<!-- yaml: (.+) -->$")
TITLE = re.compile(r'title="([^"]+)"')
COMMAND = re.compile(r"^(    |\t)\s*(\$ )?(l2m|pip|make|python3?|dask|git|cd|export) ")
MODELS: dict[str, type[Options] | None] = {
    "configuration": Config,
    "simulation": ScenarioOptions,
    "result": None,
    "suite": None,
}
"""What a block of YAML is part of; those of no model are only parsed."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page.

    Attributes
    ----------
    line
        Where it begins.
    language
        `sh`, `bash`, `python`, `yaml` or `text`.
    title
        Name of the file that a block of YAML is saved as, or `Output`; may be empty.
    not_run
        Why it is not run; empty if it is.
    part_of
        What a block of YAML is part of.
    text
        What stands in it.
    """

    line: int
    language: str
    title: str
    not_run: str
    part_of: str
    text: str


def blocks(page: Path) -> list[Block]:
    """Return the blocks of a page; a command outside of one, or a block of no language, fails."""
    found: list[Block] = []
    lines = page.read_text(encoding="utf-8").splitlines()
    k = 0
    while k < len(lines):
        opening = FENCE.match(lines[k])
        if opening is None:
            assert not COMMAND.match(lines[k]), f"{page.name}:{k + 1}: a command without a fence"
            k += 1
            continue
        indent, info = opening.groups()
        end = next(n for n in range(k + 1, len(lines)) if lines[n] == f"{indent}```")
        language = info.split(" ")[0]
        assert language in ("sh", "bash", "python", "yaml", "text"), f"{page.name}:{k + 1}: {language!r}"
        title, above = TITLE.search(info), lines[k - 1] if k else ""
        not_run, part = NOT_RUN.match(above), PLAIN.match(above)
        found.append(
            Block(
                line=k + 1,
                language=language,
                title=title[1] if title else "",
                not_run=not_run[1] if not_run else "",
                part_of=part[1] if part else "configuration",
                text="\n".join(line[len(indent) :] for line in lines[k + 1 : end]) + "\n",
            )
        )
        k = end + 1
    return found


def run_page(page: Path, folder: Path, names: dict[str, Any] | None = None) -> None:
    """Run the blocks of a page in order in a folder.

    Commands run in this process, which spares seconds of imports each. A block of YAML is loaded
    as what it is part of, and saved where it has a title. Of a block with the title Output every
    word stands in what the commands before it printed; figures may differ.

    Parameters
    ----------
    page
        The page.
    folder
        Where it runs, with what the page takes for granted.
    names
        What blocks of Python take for granted.
    """
    printed, shared = "", dict(names or {})
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("COLUMNS", "200")
        patch.setenv("NO_COLOR", "1")
        for block in blocks(page):
            where = f"{page.name}:{block.line}"
            if block.not_run:
                continue
            if block.language in ("sh", "bash"):
                printed = "".join(map(_run, commands(block)))
            elif block.language == "python":
                printed = _printed(lambda text=block.text, at=where: exec(compile(text, at, "exec"), shared))  # noqa: E501, S102
            elif block.language == "yaml":
                load(block, where)
                if block.title:
                    Path(block.title).write_text(block.text, encoding="utf-8")
            elif block.title == "Output":
                missing = words(block.text) - words(printed)
                assert not missing, f"{where}: {sorted(missing)} not in\n{printed}"


def commands(block: Block) -> list[list[str]]:
    """Return the commands of a block, without comments."""
    lines = block.text.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def load(block: Block, where: str) -> None:
    """Read a block of YAML with the model of what it is part of."""
    content = YAML(typ="safe", pure=True).load(block.text)
    model = MODELS[block.part_of]
    assert content, where
    if model is not None:
        model.model_validate(content)


def words(text: str) -> set[str]:
    """Return the words of a text, without figures and the lines of tables."""
    return {word for word in re.findall(r"[^\W\d_]{2,}", text)}


def _run(command: list[str]) -> str:
    """Run one command, which must end well, and return what it printed."""
    name, *arguments = command
    assert name == "l2m", f"{shlex.join(command)}: mark it as not run, and say why"

    def run() -> None:
        with pytest.raises(SystemExit) as end:
            main()
        assert not end.value.code, f"{shlex.join(command)}: {end.value.code}"

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["l2m", *arguments])
        printed = _printed(run)
    if "--out" in arguments:
        assert Path(arguments[arguments.index("--out") + 1]).exists()
    return printed


def _printed(run: Callable[[], None]) -> str:
    """Return what a function prints, warnings included."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            run()
        except AssertionError as error:
            raise AssertionError(f"{error}\n{out.getvalue()}") from error
    return out.getvalue()
