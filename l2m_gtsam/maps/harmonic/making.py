"""All tiles of a map, made ahead of their first use."""

from threading import Lock

from l2m_gtsam.maps.harmonic.compiled import CompiledTiles
from l2m_gtsam.maps.harmonic.entries import compiled_entry, solved_entry
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.progress import Count


def make_all(compiled: CompiledTiles, progress: Count) -> int:
    """Have all tiles of a map in its store, solved and compiled, and nothing else.

    A store that is full ends it: the other tiles are made when they are needed. None is held in
    memory.

    Parameters
    ----------
    compiled
        The tiles, and with their map its store.
    progress
        Called with the number of tiles that are done and that of all.

    Returns
    -------
    int
        How many tiles the store has.
    """
    learnt, tiles = compiled.exact.learnt, compiled.exact.tiles
    indices, lock, done = range(len(tiles)), Lock(), 0
    tiles.store.sweep(
        [
            *(solved_entry(learnt, index) for index in indices),
            *(compiled_entry(learnt, index, compiled.places(index)) for index in indices),
        ]
    )

    def make(index: int) -> bool:
        nonlocal done
        if not tiles.store.takes_more:
            return False
        compiled.compiled(index, tiles.made(index))
        with lock:
            done += 1
            progress(done, len(indices))
        return tiles.store.takes_more

    return sum(in_threads(make, indices))
