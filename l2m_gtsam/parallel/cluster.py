"""Many independent tasks on local processes or on a running Dask cluster."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from os import cpu_count
from time import sleep
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from pydantic import Field

from l2m_gtsam.errors import ClusterError, L2MError
from l2m_gtsam.options import Options
from l2m_gtsam.parallel.threads import THREADS

if TYPE_CHECKING:
    from distributed import Client, Future, Worker

Key = TypeVar("Key")
Place = TypeVar("Place")
Value = TypeVar("Value")

LOOPBACK = "127.0.0.1"
CONNECT_S = 20  # a scheduler that is there answers at once
LOOK_AGAIN_S = 0.2
NO_PAGES: dict[str, list[str]] = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}
DIED = "every worker that began it died; give the workers more memory"


class ClusterOptions(Options):
    """Who computes."""

    workers: int = Field(default=cpu_count() or 1, ge=1)
    """Processes on this machine, one core each, at most one for each task; not looked at with a
    scheduler."""
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
    L2MError
        A task raised it: no more are begun, and those that run have ended.
    ClusterError
        Dask is not installed, the scheduler does not answer or has no workers, or a task kills
        its workers.
    """
    if not keys:
        return
    # each process takes seconds of imports: one without a task would only be in the way
    needed = options.model_copy(update={"workers": min(options.workers, len(keys))})
    with connected(needed) as client:
        from distributed.scheduler import KilledWorker

        alone: list[Key] = []
        futures = _begun(client, work, keys)
        for future, key in _finished(futures):
            try:
                value = future.result()
            except KilledWorker as error:
                if work.lost is None:
                    raise ClusterError(f"{key}: {DIED}") from error
                alone.append(key)
            except L2MError:
                _let_end(client, list(futures))
                raise
            else:
                yield key, value
        yield from _one_by_one(client, work, alone)


def _let_end(client: "Client", futures: "Sequence[Future[Any]]") -> None:
    """Begin no more tasks, and wait for those that run: one that is killed leaves parts."""
    client.cancel(futures)
    ours = {each.key for each in futures}
    while any(ours & keys for keys in client.run(_running).values()):
        sleep(LOOK_AGAIN_S)


def _running(dask_worker: "Worker") -> set[Any]:
    """Return the keys of the tasks that a worker runs, cancelled ones, too."""
    return {each.key for each in dask_worker.state.executing}


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

    (future,) = _begun(client, work, [key])
    try:
        value: Value = future.result()
    except KilledWorker as error:
        if work.lost is None:
            raise ClusterError(f"{key}: {DIED}") from error
        if error.task != future.key:
            hopeless.add(work.place(key))
        return work.lost(key, DIED)
    return value


def _begun(
    client: "Client", work: Work[Key, Place, Value], keys: Sequence[Key]
) -> "dict[Future[Any], Key]":
    """Hand tasks to the workers; return their futures."""
    places = list(dict.fromkeys(map(work.place, keys)))
    prepared = {place: client.submit(work.prepare, place, pure=False) for place in places}
    # What is prepared is kept by the tasks that wait for it, and forgotten after the last.
    return {
        client.submit(work.task, key, prepared[work.place(key)], pure=False): key for key in keys
    }


def _finished(futures: "dict[Future[Any], Key]") -> "Iterator[tuple[Future[Any], Key]]":
    """Yield futures with their keys as they end, well or not; each is released after its turn."""
    from distributed import as_completed

    for future in as_completed(list(futures)):
        yield future, futures[future]
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
    # Dask's messages on its own processes are left out: results, or one last line, report them.
    silent = {"DASK_LOGGING__DISTRIBUTED": "critical"}
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with (
        dask.config.set({**NO_PAGES, "distributed.nanny.pre-spawn-environ": {**one, **silent}}),
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
