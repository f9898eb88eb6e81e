"""Files of tiles: round trip, and everything that may be wrong with them."""

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from l2m_gtsam.errors import ConfigError, MapError, Notice
from l2m_gtsam.maps.harmonic.compiled import near_from_arrays
from l2m_gtsam.maps.tile_store import NO_STORE, Arrays, Entry
from l2m_gtsam.storage import tile_folder
from l2m_gtsam.storage.tile_folder import (
    LIMIT,
    TileFolder,
    fingerprint_of,
    read_tile,
    tiles_beside,
    write_tile,
)

ENTRY = Entry("3_-1.solved", "ab" * 32)
ARRAYS: Arrays = {"mean": np.linspace(0, 1, 5), "starts": np.arange(6).reshape(2, 3)}
SAME_FILES = settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def assert_same(one: Arrays, other: Arrays) -> None:
    assert list(one) == list(other)
    for name, array in one.items():
        assert array.dtype == other[name].dtype
        np.testing.assert_array_equal(array, other[name])


@SAME_FILES
@given(
    arrays=st.dictionaries(
        st.text(max_size=8),
        hnp.arrays(
            st.sampled_from([np.float64, np.int64]),
            hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=4),
        ),
        max_size=4,
    )
)
def test_it_reads_back_equal(tmp_path: Path, arrays: dict[str, Any]) -> None:
    write_tile(tmp_path / "a.tile", ENTRY, arrays)
    assert_same(read_tile(tmp_path / "a.tile", ENTRY), arrays)
    assert fingerprint_of(tmp_path / "a.tile") == ENTRY.fingerprint


def test_other_layouts_read_back_equal(tmp_path: Path) -> None:
    turned = {"turned": np.arange(6.0).reshape(2, 3).T, "some": np.arange(8.0)[::2]}
    write_tile(tmp_path / "a.tile", ENTRY, turned)
    assert_same(read_tile(tmp_path / "a.tile", ENTRY), turned)


def content(folder: Path) -> bytes:
    write_tile(folder / "good.tile", ENTRY, ARRAYS)
    return (folder / "good.tile").read_bytes()


@SAME_FILES
@given(data=st.data())
def test_no_bit_can_change_unnoticed(tmp_path: Path, data: st.DataObject) -> None:
    damaged = bytearray(content(tmp_path))
    damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    (tmp_path / "a.tile").write_bytes(damaged)
    with pytest.raises(MapError):
        read_tile(tmp_path / "a.tile", ENTRY)


@SAME_FILES
@given(data=st.data())
def test_it_is_noticed_when_the_end_is_missing(tmp_path: Path, data: st.DataObject) -> None:
    whole = content(tmp_path)
    (tmp_path / "a.tile").write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    with pytest.raises(MapError):
        read_tile(tmp_path / "a.tile", ENTRY)


@pytest.mark.parametrize(
    "arrays",
    [
        3,
        [["a", "<f8"]],
        [["a", "|O", [1]]],
        [["a", "<f8", [-1, -1]]],
        [["a", "<f8", [1 << 62]]],
        [["a", "<f8", [0, 1 << 80]]],
        [["a", "<f8", [1] * 200]],
        [["a", ["<f8"], [1]]],
        [["a", "<f8", ["x"]]],
    ],
)
def test_a_header_that_makes_no_sense_is_refused(tmp_path: Path, arrays: object) -> None:
    header = json.dumps({"fingerprint": ENTRY.fingerprint, "arrays": arrays}).encode()
    start = tile_folder.MAGIC + (1).to_bytes(8, "little") + len(header).to_bytes(8, "little")
    (tmp_path / "a.tile").write_bytes(start + bytes(32) + header + bytes(8))
    with pytest.raises(MapError):
        read_tile(tmp_path / "a.tile", ENTRY)


@pytest.mark.parametrize("header", [b"[" * 60_000, b"[]", b"{}", b"\xff"])
def test_a_header_that_is_none_is_refused(tmp_path: Path, header: bytes) -> None:
    start = tile_folder.MAGIC + (1).to_bytes(8, "little") + len(header).to_bytes(8, "little")
    (tmp_path / "a.tile").write_bytes(start + bytes(32) + header)
    with pytest.raises(MapError):
        read_tile(tmp_path / "a.tile", ENTRY)
    assert fingerprint_of(tmp_path / "a.tile") is None


NEAR: Arrays = {
    "corner": np.zeros(3),
    "shape": np.array([1, 1, 2]),
    "starts": np.array([0, 4, 8]),
    "table": np.ones((8, 8)),
}


@pytest.mark.parametrize(
    "change",
    [
        {"starts": np.array([0, 9, 8])},
        {"starts": np.array([-4, 4, 8])},
        {"starts": np.array([0, 4, 12])},
        {"starts": np.array([0, 8])},
        {"starts": np.array([0.0, 4.0, 8.0])},
        {"shape": np.array([-1, -1, 2])},
        {"table": np.full((8, 8), np.nan)},
        {"table": np.ones((7, 8))},
    ],
)
def test_lists_that_lead_out_of_their_table_are_refused(change: Arrays) -> None:
    near_from_arrays(NEAR)
    with pytest.raises(MapError):
        near_from_arrays({**NEAR, **change})


def recalled(folder: Path, decode: Callable[[Arrays], object]) -> object:
    return TileFolder(folder, 1 << 30).recall(ENTRY, decode)


def test_what_cannot_be_decoded_is_as_good_as_damaged(tmp_path: Path) -> None:
    TileFolder(tmp_path, 1 << 30).keep(ENTRY, ARRAYS)
    assert recalled(tmp_path, len) == len(ARRAYS)

    def refused(_: Arrays) -> None:
        raise MapError("mean is not finite")

    with pytest.warns(Notice, match="mean is not finite"):
        assert recalled(tmp_path, refused) is None


def test_the_first_notice_of_a_folder_is_the_last(tmp_path: Path) -> None:
    folder = TileFolder(tmp_path / "none" / "tiles", 1 << 30)
    with pytest.warns(Notice):
        folder.keep(ENTRY, ARRAYS)
    assert not folder.takes_more
    folder.keep(ENTRY, ARRAYS)  # a second one would be an error


def test_the_size_is_an_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert isinstance(tiles_beside(tmp_path / "map.npz"), TileFolder)
    monkeypatch.setenv(LIMIT, "0")
    assert tiles_beside(tmp_path / "map.npz") is NO_STORE
    for wrong in ("much", "-1", "nan", "inf"):
        monkeypatch.setenv(LIMIT, wrong)
        with pytest.raises(ConfigError, match=LIMIT):
            tiles_beside(tmp_path / "map.npz")
    monkeypatch.setenv(LIMIT, "1e-6")
    folder = tiles_beside(tmp_path / "map.npz")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        folder.keep(ENTRY, ARRAYS)
    assert "GiB" in str(said[0].message)
    assert not (tmp_path / "map.tiles").exists()
