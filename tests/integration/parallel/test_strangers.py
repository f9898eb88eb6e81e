"""Other users of a machine reach no scheduler of ours: what they send would be run."""

import asyncio
import socket
from collections.abc import Iterator
from contextlib import suppress
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
from distributed import Client, Security
from distributed.comm.core import connect

from l2m_gtsam.parallel.cluster import ClusterOptions, connected


def address_of(client: Client) -> str:
    """Return where the scheduler listens."""
    return str(client.scheduler_info()["address"])


def reach(address: str, security: Security | None) -> None:
    """Connect as any process of this machine can, with certificates of its own or none."""
    theirs = {} if security is None else security.get_connection_args("client")

    async def ask() -> None:
        comm = await connect(address, timeout=2, **theirs)
        await comm.close()

    asyncio.run(ask())


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    with connected(ClusterOptions(workers=1)) as found:
        yield found


@pytest.mark.parametrize("security", [None, "their own"])
@pytest.mark.filterwarnings("ignore")
def test_a_stranger_is_not_let_in(client: Client, security: str | None) -> None:
    theirs = None if security is None else Security.temporary()
    address = address_of(client)
    assert address.startswith("tls://127.0.0.1:")
    places = {address, *client.scheduler_info()["workers"]}
    for each in places:
        with pytest.raises((OSError, TypeError, ValueError)):
            reach(each, theirs)
        with pytest.raises((OSError, TypeError, ValueError)):
            reach(each.replace("tls://", "tcp://"), None)
    assert client.submit(sum, (1, 2)).result() == 3
    port = client.scheduler_info()["services"]["dashboard"]
    for page in ("info/main/workers.html", "json/counts.json", "health", "api/v1/get_workers"):
        with pytest.raises(HTTPError, match="404"):
            urlopen(f"http://127.0.0.1:{port}/{page}", timeout=5)


def test_a_plain_connection_gets_no_word(client: Client) -> None:
    host, port = address_of(client).removeprefix("tls://").split(":")
    with socket.create_connection((host, int(port)), timeout=5) as plain:
        plain.sendall(b"\0" * 64)
        plain.settimeout(5)
        with suppress(ConnectionResetError):
            assert b"compression" not in plain.recv(1024)
