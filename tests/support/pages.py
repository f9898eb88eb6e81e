"""Pages of the documentation as code: the blocks of a page, and what runs them."""

import contextlib
import io
import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from l2m_gtsam.config import Config
from l2m_gtsam.options import Options
from l2m_gtsam.simulate.scenario import ScenarioOptions
from tests.support.command_line import l2m

LANGUAGES = ("sh", "bash", "python", "yaml", "text")
FENCE = re.compile(r"^( *)```(\w*)(.*)$")
NOT_RUN = re.compile(r"^ *<!-- not run: (.+) -->$")
PART = re.compile(r"^ *<!-- yaml: (.+) -->$")
TITLE = re.compile(r'title="([^"]+)"')
COMMAND = re.compile(r"^(    |\t)\s*(\$ )?(l2m|pip|make|python3?|dask|git|cd|export) ")
MODELS: dict[str, type[Options] | None] = {
    "configuration": Config,
    "simulation": ScenarioOptions,
    "result": None,
    "suite": None,
    "manifest": None,
}
"""What a block of YAML is part of; those of no model are only parsed."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page.

    Attributes
    ----------
    where
        Page and line.
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

    where: str
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
        if opening := FENCE.match(lines[k]):
            end = next(n for n in range(k + 1, len(lines)) if lines[n] == f"{opening[1]}```")
            found.append(_block(page, lines, k, end))
            k = end
        else:
            assert not COMMAND.match(lines[k]), f"{page.name}:{k + 1}: a command without a fence"
        k += 1
    return found


def _block(page: Path, lines: list[str], first: int, last: int) -> Block:
    """Return the block between two fences of a page."""
    indent, language, attributes = FENCE.fullmatch(lines[first]).groups()  # type: ignore[union-attr]
    assert language in LANGUAGES, f"{page.name}:{first + 1}: {language!r} is not of {LANGUAGES}"
    title, above = TITLE.search(attributes), lines[first - 1] if first else ""
    not_run, part = NOT_RUN.match(above), PART.match(above)
    inside = (line[len(indent) :] for line in lines[first + 1 : last])
    return Block(
        where=f"{page.name}:{first + 1}",
        language=language,
        title=title[1] if title else "",
        not_run=not_run[1] if not_run else "",
        part_of=part[1] if part else "configuration",
        text="\n".join(inside) + "\n",
    )


def run_page(page: Path, folder: Path) -> None:
    """Run the blocks of a page in order in a folder, which has what the page takes for granted.

    Commands run in this process, which spares seconds of imports each. A block of YAML is loaded
    as what it is part of, and saved where it has a title. Of a block with the title Output every
    word stands in what the commands before it printed; figures may differ.
    """
    printed, names = "", dict[str, Any]()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for block in blocks(page):
            if block.not_run:
                continue
            if block.language in ("sh", "bash"):
                printed = "".join(map(_run, commands(block)))
            elif block.language == "python":
                run_python(block, names)
            elif block.language == "yaml":
                save(block)
            elif block.title == "Output":
                missing = words(block.text) - words(printed)
                assert not missing, f"{block.where}: {sorted(missing)} not in\n{printed}"


def run_python(block: Block, names: dict[str, Any]) -> None:
    """Run a block of Python with the names that those before it left."""
    with contextlib.redirect_stdout(io.StringIO()):
        exec(compile(block.text, block.where, "exec"), names)  # noqa: S102 - our own pages


def save(block: Block) -> None:
    """Load a block of YAML with the model of what it is part of, and save it if it has a title."""
    content = YAML(typ="safe", pure=True).load(block.text)
    model = MODELS[block.part_of]
    assert content, block.where
    if model is not None:
        model.model_validate(content)
    if block.title:
        Path(block.title).write_text(block.text, encoding="utf-8")


def commands(block: Block) -> list[list[str]]:
    """Return the commands of a block, without comments."""
    lines = block.text.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def words(text: str) -> set[str]:
    """Return the words of a text, without figures and the lines of tables."""
    return set(re.findall(r"[^\W\d_]{2,}", text))


def _run(command: list[str]) -> str:
    """Run one command, which must end well, and return what it printed."""
    name, *arguments = command
    assert name == "l2m", f"{shlex.join(command)}: mark it as not run, and say why"
    run = l2m(*arguments)
    if "--out" in arguments:
        assert Path(arguments[arguments.index("--out") + 1]).exists()
    return run.out + run.err
