"""Files are whole or not there."""

import stat
from pathlib import Path

import pytest

from l2m_gtsam.errors import L2MError, OutputError
from l2m_gtsam.storage.files import atomic_path, source_file


def test_the_name_appears_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with atomic_path(path) as temporary:
        temporary.write_text("whole")
        assert not path.exists()
        assert temporary.parent == path.parent
    assert path.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [path]


def test_permissions_are_those_of_any_new_file(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    with atomic_path(tmp_path / "atomic"):
        pass
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("plain", "atomic")]
    assert modes[0] == modes[1]


@pytest.mark.parametrize("where", ["missing/a", "file/a"])
def test_a_parent_that_is_no_folder_is_one_line(tmp_path: Path, where: str) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(OutputError, match="cannot be written") as error,
        atomic_path(tmp_path / where),
    ):
        pass
    assert "\n" not in str(error.value)


def test_a_folder_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="folder"), atomic_path(tmp_path / "folder"):
        pass
    assert [each.name for each in tmp_path.iterdir()] == ["folder"]


def test_the_digest_of_a_file_is_sha256(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    # FIPS 180-2, appendix B.1.
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert source_file(tmp_path / "a").sha256 == expected


def test_the_digest_of_a_folder_covers_names_and_where_files_end(tmp_path: Path) -> None:
    contents = [{"a": "xy", "b": "z"}, {"a": "x", "b": "yz"}, {"a": "xy", "c": "z"}]
    digests = []
    for index, content in enumerate(contents):
        folder = tmp_path / str(index)
        folder.mkdir()
        for name, text in content.items():
            (folder / name).write_text(text)
        digests.append(source_file(folder).sha256)
    assert len(set(digests)) == len(contents)


def test_the_digest_of_nothing_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(L2MError, match="nowhere: cannot be read"):
        source_file(tmp_path / "nowhere")
