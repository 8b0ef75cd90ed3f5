"""Which absent peer a new link belongs to."""

from __future__ import annotations

from rmpa.bridge.data.io.absent_peers import Absent, AbsentPeers
from rmpa.bridge.permission_gate import OPEN_GATE, PermissionGate
from rmpa.config.settings import TrustSettings
from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.trust.permissions import Permissions


def identity(name: str, run: int, address: str = "10.0.0.1") -> Identity:
    return Identity(Guid.of(address, 1000), bytes([run]) * 16, name)


SECURED = PermissionGate(Permissions(TrustSettings()))


def absent(*known: Identity, gate: PermissionGate = OPEN_GATE) -> AbsentPeers:
    made = AbsentPeers(lambda _: None, lambda _: None, gate)
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


def test_in_a_secured_mesh_the_address_of_an_absent_module_is_worth_nothing() -> None:
    """Each member chooses the address in its hello; the name alone is proved."""
    peers = absent(identity("arm", 1), gate=SECURED)
    assert peers.number_of(identity("thief", 9)) is None
    assert peers.back(identity("thief", 9)) is None
    found = peers.back(identity("arm", 2, "10.0.0.7"))
    assert found is not None, "another run of the module, at another address"
    assert found.peer == 1


def test_in_a_plain_mesh_a_module_at_the_same_address_is_the_one_that_was_absent() -> None:
    found = absent(identity("arm", 1)).back(identity("renamed", 2))
    assert found is not None
    assert found.peer == 1
