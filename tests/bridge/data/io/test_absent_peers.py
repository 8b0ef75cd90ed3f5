"""Which absent peer a new link belongs to."""

from __future__ import annotations

from rmpa.bridge.data.io.absent_peers import Absent, AbsentPeers
from rmpa.core.guid import Guid
from rmpa.core.identity import Identity


def identity(name: str, run: int, address: str = "10.0.0.1") -> Identity:
    return Identity(Guid.of(address, 1000), bytes([run]) * 16, name)


def absent(*known: Identity) -> AbsentPeers:
    made = AbsentPeers(lambda _: None, lambda _: None)
    for number, one in enumerate(known, 1):
        made.add(Absent(number, one, 0.0, {}))
    return made


def test_the_same_run_has_its_number_again() -> None:
    peers = absent(identity("arm", 1), identity("leg", 2, "10.0.0.2"))
    assert peers.number_of(identity("leg", 2, "10.0.0.2")) == 2
    found = peers.back(identity("leg", 2, "10.0.0.2"))
    assert found is not None
    assert found.peer == 2
    assert peers.number_of(identity("leg", 2, "10.0.0.2")) is None


def test_a_module_that_claims_the_run_of_another_one_is_not_it() -> None:
    peers = absent(identity("arm", 1))
    assert peers.number_of(identity("thief", 1, "10.0.0.9")) is None
    assert peers.back(identity("thief", 1, "10.0.0.9")) is None
    assert peers.number_of(identity("arm", 1)) == 1
