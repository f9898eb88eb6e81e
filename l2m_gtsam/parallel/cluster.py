"""Many independent tasks on local processes or on a running Dask cluster."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from os import cpu_count
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from pydantic import Field

from l2m_gtsam.errors import ClusterError
from l2m_gtsam.options import Options
from l2m_gtsam.parallel.threads import THREADS

if TYPE_CHECKING:
    from distributed import Client, Future

Key = TypeVar("Key")
Place = TypeVar("Place")
Value = TypeVar("Value")

LOOPBACK = "127.0.0.1"
CONNECT_S = 20  # a scheduler that is there answers at once
NO_PAGES: dict[str, list[str]] = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}
DIED = "every worker that began it died; give the workers more memory"


class ClusterOptions(Options):
    """Who computes."""

    workers: int = Field(default=cpu_count() or 1, ge=1)
    """Processes on this machine, one core each; not looked at with a scheduler."""
    scheduler: str | None = None
    """Address of a running Dask scheduler, tcp://host:port, whose workers have this package."""


@dataclass(frozen=True)
class Work(Generic[Key, Place, Value]):
    """Tasks, and what several of them need first. Functions must be importable on the workers.

    Attributes
    ----------
    place
        What a task needs, by name, from its key.
    prepare
        Makes what is needed from its name, once for all tasks that need it.
    task
        The result from the key and what was prepared for it.
    lost
        What stands for the result of a task, from its key and a reason, when every worker that
        began it died, also when it was alone; a ClusterError ends all work where it is absent.
    """

    place: Callable[[Key], Place]
    prepare: Callable[[Place], Any]
    task: Callable[[Key, Any], Value]
    lost: Callable[[Key, str], Value] | None = None


def computed(
    work: Work[Key, Place, Value], keys: Sequence[Key], options: ClusterOptions
) -> Iterator[tuple[Key, Value]]:
    """Yield each key with its result, as they get ready; a lost worker's tasks go to others.

    Parameters
    ----------
    work
        What is to be done.
    keys
        Of the tasks, in the order in which they are begun: best those of one place together.
    options
        Who computes.

    Raises
    ------
    ClusterError
        Dask is not installed, the scheduler does not answer or has no workers, or a task kills
        its workers.
    """
    if not keys:
        return
    with connected(options) as client:
        from distributed.scheduler import KilledWorker

        alone: list[Key] = []
        for key, future in _finished(client, work, keys):
            try:
                value = future.result()
            except KilledWorker as error:
                if work.lost is None:
                    raise ClusterError(f"{key}: {DIED}") from error
                alone.append(key)
            else:
                yield key, value
        yield from _one_by_one(client, work, alone)


def _one_by_one(
    client: "Client", work: Work[Key, Place, Value], keys: Sequence[Key]
) -> Iterator[tuple[Key, Value]]:
    """Yield results of tasks whose workers died; one that kills them alone, too, is lost.

    A worker that dies takes along what waits on it, through no fault of its own.
    """
    hopeless: set[Place] = set()  # whose preparation kills workers
    for key in keys:
        if work.place(key) not in hopeless:
            yield key, _alone(client, work, key, hopeless)
        elif work.lost is not None:
            yield key, work.lost(key, DIED)


def _alone(
    client: "Client", work: Work[Key, Place, Value], key: Key, hopeless: set[Place]
) -> Value:
    """Return the result of a task that has all workers to itself, or what stands for it."""
    from distributed.scheduler import KilledWorker

    _, future = next(_finished(client, work, [key]))
    try:
        value: Value = future.result()
    except KilledWorker as error:
        if work.lost is None:
            raise ClusterError(f"{key}: {DIED}") from error
        if error.task != future.key:
            hopeless.add(work.place(key))
        return work.lost(key, DIED)
    return value


def _finished(
    client: "Client", work: Work[Key, Place, Value], keys: Sequence[Key]
) -> "Iterator[tuple[Key, Future[Any]]]":
    """Yield the futures of tasks as they end, well or not; each is released after its turn."""
    from distributed import as_completed

    places = list(dict.fromkeys(map(work.place, keys)))
    prepared = {place: client.submit(work.prepare, place, pure=False) for place in places}
    names = {
        client.submit(work.task, key, prepared[work.place(key)], pure=False): key for key in keys
    }
    del prepared  # each is kept by the tasks that wait for it, and forgotten after the last
    for future in as_completed(list(names)):
        yield names[future], future
        future.release()


@contextmanager
def connected(options: ClusterOptions) -> "Iterator[Client]":
    """Yield a connection to the workers, and stop those that were started here."""
    try:
        import cryptography  # noqa: F401 - the keys of a local cluster need it, and say so late
        import dask
        from distributed import Client, LocalCluster, Security
    except ImportError as error:
        raise ClusterError("Dask is missing: pip install 'l2m-gtsam[cluster]'") from error
    if options.scheduler is not None:
        try:
            client = Client(options.scheduler, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise ClusterError(f"--scheduler {options.scheduler}: {error}") from error
        with client:
            _await_worker(client, options.scheduler)
            yield client
        return
    # Whoever talks to a scheduler runs code as its owner: keys of this run alone, never on a disk,
    # keep out other users of the machine. Each worker has a core to itself, and one thread.
    one = {"OPENBLAS_NUM_THREADS": 1, "OMP_NUM_THREADS": 1, THREADS: 1}
    with (
        dask.config.set({**NO_PAGES, "distributed.nanny.pre-spawn-environ": one}),
        LocalCluster(
            n_workers=options.workers,
            threads_per_worker=1,
            host=f"tls://{LOOPBACK}",
            security=Security.temporary(),
            dashboard_address=f"{LOOPBACK}:0",
            memory_limit=None,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


def _await_worker(client: "Client", scheduler: str) -> None:
    """Wait for the first worker of a scheduler, which may be starting; not for ever."""
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError as error:
        raise ClusterError(
            f"--scheduler {scheduler}: has no workers; start some: dask worker {scheduler} "
            "--nthreads 1"
        ) from error
