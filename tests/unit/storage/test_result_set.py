"""Results as a set: all or none, known by their digests, refused when they are mixed."""

import json
import shutil
from pathlib import Path

import pytest

from l2m_gtsam.errors import CalibrationError, OutputError
from l2m_gtsam.storage import result_set
from l2m_gtsam.storage.result_set import SET_FILE, check_set, published

NAMES = ("a.txt", "b.txt", "c.txt")


class StoppedError(Exception):
    """Stands for a kill."""


def write(folder: Path, content: str, *names: str, adds: bool = False) -> None:
    """Publish a set of files that all have one content."""
    with published(folder, *NAMES, adds=adds) as stage:
        for name in names or NAMES:
            (stage / name).write_text(content)


def half(folder: Path) -> None:
    """Write a file of a set and then fail."""
    with published(folder, *NAMES) as stage:
        (stage / "a.txt").write_text("half")
        raise StoppedError


def there(folder: Path) -> dict[str, str]:
    """Return the content of the files, and check that nothing hidden is left."""
    found = {each.name: each.read_text() for each in folder.iterdir()}
    assert not [name for name in found if name.startswith(".")]
    found.pop(SET_FILE)
    return found


def test_a_set_replaces_the_one_before(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("of the user")
    write(tmp_path, "old")
    write(tmp_path, "new", "a.txt", "b.txt")
    assert there(tmp_path) == {"a.txt": "new", "b.txt": "new", "notes.txt": "of the user"}
    write(tmp_path, "later", "b.txt", adds=True)
    assert there(tmp_path) == {"a.txt": "new", "b.txt": "later", "notes.txt": "of the user"}
    for name in ("a.txt", "b.txt", "notes.txt"):
        check_set(tmp_path / name, CalibrationError)


def test_what_fails_changes_nothing(tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    with pytest.raises(StoppedError):
        half(out)
    assert not (tmp_path / "new").exists()
    write(out, "old")
    with pytest.raises(StoppedError):
        half(out)
    assert there(out) == dict.fromkeys(NAMES, "old")


@pytest.mark.parametrize("step", range(12))
def test_stopped_at_any_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    write(tmp_path, "old")
    taken = 0
    with monkeypatch.context() as patch:

        def counted(name: str) -> None:
            original = getattr(Path, name)

            def stopping(self: Path, *arguments: object, **named: object) -> object:
                nonlocal taken
                taken += 1
                if taken > step:
                    raise StoppedError
                return original(self, *arguments, **named)

            patch.setattr(Path, name, stopping)

        # What changes the folder; a kill has no time to tidy up either.
        patch.setattr(shutil, "rmtree", lambda *_, **__: None)
        for name in ("rename", "replace", "unlink", "rmdir"):
            counted(name)
        try:
            write(tmp_path, "new", "a.txt", "b.txt")
        except StoppedError:
            pass
        else:
            assert step >= taken
    for name in NAMES:
        check_set(tmp_path / name, CalibrationError)  # whoever reads has all of one run
    old, new = dict.fromkeys(NAMES, "old"), dict.fromkeys(NAMES[:2], "new")
    visible = {
        each.name: each.read_text()
        for each in tmp_path.iterdir()
        if not each.name.startswith(".") and each.name != SET_FILE
    }
    assert visible in (old, new)
    write(tmp_path, "next")
    assert there(tmp_path) == dict.fromkeys(NAMES, "next")


def test_files_that_hold_times_are_published_but_not_listed(tmp_path: Path) -> None:
    def write_timed(folder: Path, *names: str) -> None:
        with published(folder, *NAMES, unlisted=("c.txt",)) as stage:
            for name in names:
                (stage / name).write_text(f"{name} of {folder.name}")

    one, other = tmp_path / "one", tmp_path / "other"
    for folder in (one, other):
        write_timed(folder, "a.txt", "c.txt")
    listed = json.loads((one / SET_FILE).read_text())["files"]
    assert listed.keys() == {"a.txt"}
    shutil.copy(other / "c.txt", one / "c.txt")
    check_set(one / "c.txt", CalibrationError)
    write_timed(one, "c.txt")
    assert [each.name for each in one.iterdir()] == ["c.txt"]


@pytest.mark.parametrize("name", NAMES)
def test_a_mixture_is_refused(tmp_path: Path, name: str) -> None:
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    write(ours, "ours")
    write(theirs, "theirs")
    shutil.copy(theirs / name, ours / name)
    with pytest.raises(CalibrationError, match=f"{name}: is not of the run that results.json, "):
        check_set(ours / name, CalibrationError)
    alone = tmp_path / "alone"
    alone.mkdir()
    shutil.copy(theirs / name, alone / name)
    check_set(alone / name, CalibrationError)


@pytest.mark.parametrize("content", ["", "{}", "[1]", "{" * 9999, '{"format": "l2m-results"}'])
def test_a_damaged_list(tmp_path: Path, content: str) -> None:
    write(tmp_path, "old")
    (tmp_path / SET_FILE).write_text(content)
    with pytest.raises(CalibrationError, match=r"results.json: damaged"):
        check_set(tmp_path / "a.txt", CalibrationError)
    write(tmp_path, "new")
    check_set(tmp_path / "a.txt", CalibrationError)


def test_a_name_that_is_taken(tmp_path: Path) -> None:
    (tmp_path / "b.txt").mkdir()
    with pytest.raises(OutputError, match=r"b.txt: exists and is not a regular file"):
        write(tmp_path, "new")


def test_names_outside_are_not_removed(tmp_path: Path) -> None:
    out, precious = tmp_path / "out", tmp_path / "precious"
    precious.write_text("mine")
    write(out, "old")
    ready = out / f".{result_set.STAGE}.12345678{result_set.READY}"
    ready.mkdir()
    (ready / result_set.GONE).write_text("../precious\n/etc/hostname\n..\n.\n")
    result_set.finish(out)
    assert precious.exists()
    assert not ready.exists()
    assert there(out) == dict.fromkeys(NAMES, "old")


def test_a_list_of_an_earlier_version_is_read(tmp_path: Path) -> None:
    """It had a fingerprint of its own, which nothing is known by any more."""
    write(tmp_path, "old")
    listed = json.loads((tmp_path / SET_FILE).read_text())
    assert sorted(listed) == ["files", "format", "version"]
    former = {**listed, "version": 1, "fingerprint": "1" * 64}
    (tmp_path / SET_FILE).write_text(json.dumps(former))
    check_set(tmp_path / "a.txt", CalibrationError)
    (tmp_path / "a.txt").write_text("new")
    with pytest.raises(CalibrationError, match="is not of the run"):
        check_set(tmp_path / "a.txt", CalibrationError)
