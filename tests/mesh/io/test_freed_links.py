"""A link that has ended is freed at once, with all that waited for it, before the garbage collector runs."""

from __future__ import annotations

import gc
import weakref
from typing import TYPE_CHECKING

import pytest

from tests.mesh.io.meshes import Peer, linked_pair, until

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.mesh.io.link import Connection, PeerLink

MB = 1 << 20


@pytest.fixture(autouse=True)
def no_collector() -> Iterator[None]:
    gc.disable()
    yield
    gc.enable()


def references(one: Peer, other: Peer) -> list[weakref.ref[PeerLink] | weakref.ref[Connection]]:
    """A peer's link to another one, and its two connections."""
    link = one.link(other)
    assert link.bulk_connection is not None
    return [weakref.ref(link), weakref.ref(link.connection), weakref.ref(link.bulk_connection)]


@pytest.mark.parametrize("way", ["close", "abort", "end"])
async def test_an_ended_link_is_gone_with_what_waited(way: str) -> None:
    async with linked_pair(lanes=False) as (one, other):
        one.link(other).bulk._on_wanted()
        await until(lambda: one.link(other).bulk_connection is not None, "a bulk lane")
        await until(lambda: other.link(one).bulk_connection is not None, "a bulk lane")
        links = [*references(one, other), *references(other, one)]
        for _ in range(20):
            one.link(other).bulk.send(1, 1, 0, bytes(MB))
        assert one.link(other).queue_bytes
        if way == "end":
            await other.mesh.close()
        else:
            getattr(one.link(other), way)("the test says so")
        for peer in (one, other):
            await until(lambda peer=peer: peer.downs, "the end")  # type: ignore[misc]
        for peer in (one, other):
            for seen in (peer.ups, peer.downs, peer.clocks, peer.lanes_lost):
                seen.clear()
        await until(lambda: not any(link() for link in links), "nobody holds the old links")
