"""The results of a run as a set: published together or not at all, known by their digests.

Files are written to a hidden folder beside their places. When all are complete the hidden folder is
renamed, in one step: from then on they count, and are moved to their places. A run that is killed
before leaves the old results, one that is killed later leaves what the next run, or whoever reads,
only has to move. ``results.json`` lists the files with their digests. What identifies a result is
the report id in it, see ``report_id``.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter, ValidationError

from l2m_gtsam.errors import L2MError, OutputError
from l2m_gtsam.records.record import Record
from l2m_gtsam.storage.bounded import read_content
from l2m_gtsam.storage.files import ensure_folder, flush, source_file, unwritten
from l2m_gtsam.storage.parts import only_one, part_folder

SET_FILE = "results.json"
GONE = "gone"  # in the hidden folder: names that a run replaces by nothing
MAX_BYTES = 1_000_000
STAGE, READY = "l2m", ".ready"  # .l2m.1a2b3c4d.part, and .ready when it is complete
WAIT_S = 60.0  # for another run that moves its files


@dataclass(frozen=True)
class _SetFile(Record):
    format: Literal["l2m-results"]
    version: Literal[1, 2]  # the first had a fingerprint of the list
    files: dict[str, str]


_SET = TypeAdapter(_SetFile)


@contextmanager
def published(
    folder: Path, *names: str, adds: bool = False, unlisted: Sequence[str] = ()
) -> Iterator[Path]:
    """Give a hidden folder to write results to, and publish them together when the block ends well.

    Parameters
    ----------
    folder
        Where they are to be; made if it is missing, and removed again if nothing comes of it.
    names
        Files that may be there. Those of an earlier run that this one does not write are removed.
    adds
        Whether files are added to the set that is there, whose others then stay.
    unlisted
        Files that are published with the others, but have no digest in the list: they hold times.
        Where nothing else is written there is no list.

    Raises
    ------
    OutputError
        They cannot be written.
    """
    for name in names:
        if (folder / name).exists() and not (folder / name).is_file():
            raise OutputError(f"{folder / name}: exists and is not a regular file")
    try:
        with made(folder), part_folder(folder / STAGE) as stage:
            with _said_of(stage, folder):
                yield stage
            kept, new = _files_of(folder) if adds else {}, _digests(stage, unlisted)
            gone = set() if adds else {*names} - {each.name for each in stage.iterdir()}
            _list(stage, {**kept, **new}, gone)
            _commit(stage, folder)
    except OSError as error:
        raise unwritten(folder, error) from error


@contextmanager
def made(folder: Path) -> Iterator[None]:
    """Make a folder and those above it; take away those that stay empty when the block fails.

    Raises
    ------
    OutputError
        It cannot be made.
    """
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    ensure_folder(folder)
    try:
        yield
    except BaseException:
        with suppress(OSError):
            for each in missing:
                each.rmdir()
        raise


def check_set(path: Path, error: type[L2MError]) -> None:
    """Refuse a file that is not of the run whose results lie beside it.

    Nothing is said of a file that is there alone, or of results of earlier versions.

    Parameters
    ----------
    path
        A file of results.
    error
        What to raise.
    """
    finish(path.parent)
    listed = _listed(path.parent, error)
    if listed is None or path.name not in listed.files:
        return
    if source_file(path).sha256 != listed.files[path.name]:
        others = sorted(name for name in listed.files if name != path.name)
        raise error(
            f"{path}: is not of the run that {', '.join([SET_FILE, *others])} beside it are of, "
            f"or was edited; run the command again, or put {path.name} into a folder of its own"
        )


def finish(folder: Path) -> None:
    """Move complete results to their places that a run had no time to move."""
    with suppress(OSError):
        if any(folder.glob(f".{STAGE}.*{READY}")):
            with only_one(folder, WAIT_S):
                _move_all(folder)


def _listed(folder: Path, error: type[L2MError]) -> _SetFile | None:
    source = folder / SET_FILE
    if not source.exists():
        return None
    try:
        return _SET.validate_json(read_content(source, MAX_BYTES, error))
    except ValidationError as reason:
        raise error(f"{source}: damaged; run the command again, or remove it") from reason


def _files_of(folder: Path) -> dict[str, str]:
    """Return the files of the set that is there; none if it is damaged."""
    finish(folder)
    try:
        listed = _listed(folder, OutputError)
    except OutputError:
        return {}
    return {} if listed is None else listed.files


def _digests(stage: Path, unlisted: Sequence[str]) -> dict[str, str]:
    left_out = {SET_FILE, *unlisted}
    return {
        each.name: source_file(each).sha256 for each in stage.iterdir() if each.name not in left_out
    }


def _list(stage: Path, files: Mapping[str, str], gone: Collection[str]) -> None:
    """Write the list of a set, with the digests of all that is in it, and what it replaces."""
    if not files:
        _write_flushed(stage / GONE, "\n".join(sorted({*gone, SET_FILE})))
        flush(stage)
        return
    content = _SetFile("l2m-results", 2, dict(sorted(files.items())))
    _write_flushed(stage / SET_FILE, f"{_SET.dump_json(content, indent=1).decode()}\n")
    _write_flushed(stage / GONE, "\n".join(sorted(gone)))
    flush(stage)


def _write_flushed(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
    flush(path)


def _commit(stage: Path, folder: Path) -> None:
    with only_one(folder, WAIT_S):
        _move_all(folder)  # of one that was killed
        stage.rename(stage.with_suffix(READY))
        flush(folder)
        _move_all(folder)


def _move_all(folder: Path) -> None:
    for ready in sorted(folder.glob(f".{STAGE}.*{READY}")):
        _move(ready, folder)


def _move(ready: Path, folder: Path) -> None:
    """Move files to their places, their list last; any step of it may have been made before."""
    listed = ready / SET_FILE
    gone = ready / GONE
    if gone.exists():
        for name in gone.read_text(encoding="utf-8").splitlines():
            if name == Path(name).name != "..":
                (folder / name).unlink(missing_ok=True)
        for each in ready.iterdir():
            if each not in (listed, gone):
                each.replace(folder / each.name)
    if listed.exists():
        listed.replace(folder / SET_FILE)
    gone.unlink(missing_ok=True)
    ready.rmdir()
    flush(folder)


@contextmanager
def _said_of(stage: Path, folder: Path) -> Iterator[None]:
    """Name the files in errors as they will be called."""
    try:
        yield
    except L2MError as error:
        raise type(error)(str(error).replace(str(stage), str(folder))) from error
