"""Tiles that a map keeps beside its file: the same bits, and nothing that is wrong does harm."""

import multiprocessing
import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import Notice
from l2m_gtsam.maps.harmonic import compiled, compiled_tile, tiles
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.learnt import Learnt
from l2m_gtsam.maps.harmonic.tiles import Tile, solved_tile
from l2m_gtsam.storage import tile_folder
from l2m_gtsam.storage.tile_folder import TileFolder
from tests.worlds.harmonic import OPTIONS, POST, fitted_map, queries, readings

PLENTY = 1 << 30


@cache
def plain() -> HarmonicMap:
    """Return a small map with sources, of a few tiles."""
    return fitted_map()


def beside(folder: Path, most_bytes: int = PLENTY) -> HarmonicMap:
    """Return the map with its tiles in a folder, and none in memory."""
    bare = HarmonicMap.condition(plain().learnt, plain().options)
    return bare.with_store(TileFolder(folder, most_bytes))


Answers = tuple[FloatArray, ...]


def answers(field_map: HarmonicMap) -> Answers:
    """Return all that a drive asks of a map."""
    sample, fast = field_map.query(queries()), field_map.compile().field_and_gradient(queries())
    return sample.field, sample.gradient, sample.variance, *fast


@cache
def expected() -> Answers:
    return answers(plain())


def assert_right(field_map: HarmonicMap) -> None:
    for one, other in zip(answers(field_map), expected(), strict=True):
        np.testing.assert_array_equal(one, other)


def refuse_making(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail where a tile is solved or compiled."""

    def refused(*_: object) -> None:
        raise AssertionError("a tile was made that is kept")

    expected()
    monkeypatch.setattr(tiles, "solved_tile", refused)
    monkeypatch.setattr(compiled, "compile_tile", refused)


def make_all(field_map: HarmonicMap) -> None:
    field_map.make_tiles(lambda _done, _total: None)


def filled(folder: Path) -> list[Path]:
    """Return the files of all tiles of the map, kept in a folder."""
    make_all(beside(folder))
    files = sorted(folder.iterdir())
    assert len(files) == 2 * len(plain().tiles)
    return files


def one_notice(work: Callable[[], object]) -> str:
    """Return the one notice that work gives."""
    with pytest.warns(Notice) as said:
        work()
    assert len(said) == 1
    text = str(said[0].message)
    assert "\n" not in text
    return text


def test_tiles_that_are_kept_are_the_same_to_the_last_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len(plain().tiles) > 1
    filled(tmp_path)
    refuse_making(monkeypatch)
    assert_right(beside(tmp_path))
    for kept, solved in zip(beside(tmp_path).tiles, plain().tiles, strict=True):
        np.testing.assert_array_equal(kept.weights.factor.values, solved.weights.factor.values)
        assert kept.hyperparameters == solved.hyperparameters


def test_the_first_use_keeps_what_it_makes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_right(beside(tmp_path / "tiles"))
    refuse_making(monkeypatch)
    assert_right(beside(tmp_path / "tiles"))


def test_a_tile_that_no_grid_is_good_enough_for_is_kept_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(compiled_tile, "GRADIENT_TOLERANCE", 1e-30)
        filled(tmp_path)
    refuse_making(monkeypatch)
    found = beside(tmp_path).compile().field_and_gradient(queries())
    for one, other in zip(found, plain().field_and_gradient(queries()), strict=True):
        np.testing.assert_array_equal(one, other)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-8])


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def lengthened(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\0" * 8)


def flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-20] ^= 1
    path.write_bytes(content)


def of_another_version(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(tile_folder.MAGIC)] += 1
    path.write_bytes(content)


def foreign(path: Path) -> None:
    path.write_bytes(b"PK\3\4" + bytes(500))


def a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize("spoil", [cut, emptied, lengthened, flipped, of_another_version, foreign])
def test_what_is_damaged_is_made_anew_with_one_line(
    tmp_path: Path, spoil: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in filled(tmp_path):
        spoil(path)
    text = one_notice(lambda: assert_right(beside(tmp_path)))
    assert str(tmp_path) in text
    assert "made anew" in text
    refuse_making(monkeypatch)  # and replaced
    assert_right(beside(tmp_path))


def test_what_can_be_neither_read_nor_replaced_is_one_line(tmp_path: Path) -> None:
    for path in filled(tmp_path):
        a_folder(path)
    one_notice(lambda: assert_right(beside(tmp_path)))


def test_tiles_of_another_map_are_not_used(tmp_path: Path) -> None:
    loud = OPTIONS.model_copy(
        update={"hyperparameters": plain().learnt.hyperparameters.model_copy(update={"noise": 0.4})}
    )
    make_all(HarmonicMap.fit(*readings(), loud, POST).with_store(TileFolder(tmp_path, PLENTY)))
    text = one_notice(lambda: assert_right(beside(tmp_path)))
    assert "another map" in text


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "tiles").write_text("a file")
    text = one_notice(lambda: assert_right(beside(tmp_path / "tiles")))
    assert "not kept" in text
    text = one_notice(lambda: assert_right(beside(tmp_path / "missing" / "tiles")))
    assert "not kept" in text


def test_a_folder_that_can_only_be_read_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    filled(tmp_path)
    monkeypatch.setattr(tile_folder, "renamed_path", None)
    assert_right(beside(tmp_path))


def test_the_size_is_bounded(tmp_path: Path) -> None:
    sizes = [path.stat().st_size for path in filled(tmp_path / "all")]
    most, some = sum(sizes) // 2, tmp_path / "some"
    for _ in range(2):
        text = one_notice(lambda: assert_right(beside(some, most)))
        assert "L2M_TILES_GIB" in text
        assert 0 < sum(path.stat().st_size for path in some.iterdir()) <= most


def test_making_all_ends_where_the_folder_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one_notice(lambda: make_all(beside(tmp_path, 1)))
    assert not list(tmp_path.iterdir())
    refuse_making(monkeypatch)
    assert HarmonicMap.condition(plain().learnt, OPTIONS).make_tiles(print) == 0


def test_making_all_leaves_nothing_else(tmp_path: Path) -> None:
    names = {path.name for path in filled(tmp_path)}
    (tmp_path / "99_99.solved.tile").write_bytes(b"of a tile that is no more")
    (tmp_path / ".1_1.solved.tile.0123abcd.part").touch()
    (tmp_path / "notes.txt").write_text("not ours")
    assert {path.name for path in filled_again(tmp_path)} == {*names, "notes.txt"}


def filled_again(folder: Path) -> list[Path]:
    told: list[tuple[int, int]] = []
    count = beside(folder).make_tiles(lambda done, total: told.append((done, total)))
    assert count == len(plain().tiles)
    assert told == [(k + 1, count) for k in range(count)]
    return list(folder.iterdir())


def test_a_map_that_grew_makes_only_tiles_that_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    filled(tmp_path)
    points, field = readings(60, seed=4)
    grown = plain().updated(points + np.array([2.6, 0.0, 0.0]), field)
    made: list[int] = []

    def counted(learnt: Learnt, index: int) -> Tile:
        made.append(index)
        return solved_tile(learnt, index)

    monkeypatch.setattr(tiles, "solved_tile", counted)
    # What the new readings changed is swept, without a notice.
    make_all(grown.with_store(TileFolder(tmp_path, PLENTY)))
    assert 0 < len(made) < len(grown.tiles)
    found = HarmonicMap.condition(grown.learnt, grown.options)
    kept = found.with_store(TileFolder(tmp_path, PLENTY))
    np.testing.assert_array_equal(kept.query(queries()).field, found.query(queries()).field)


def test_another_process_uses_the_same_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    filled(tmp_path)
    refuse_making(monkeypatch)
    assert_right(pickle.loads(pickle.dumps(beside(tmp_path))))  # noqa: S301


def use(folder: Path) -> Answers:
    return answers(beside(folder))


def test_two_processes_at_once_do_no_harm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain()
    expected()
    with multiprocessing.get_context("fork").Pool(2) as pool:
        found = pool.map(use, [tmp_path] * 4, chunksize=1)
    for each in found:
        for one, other in zip(each, expected(), strict=True):
            np.testing.assert_array_equal(one, other)
    assert not list(tmp_path.glob("*.part"))
    refuse_making(monkeypatch)
    assert_right(beside(tmp_path))
