"""The attacks of the bench are what it says: only the group key tells them from what members send."""

from __future__ import annotations

import importlib.util
import sys
import time
from typing import TYPE_CHECKING

import pytest

pytest.importorskip("cryptography")

from lab.bed.members import MeasuredMesh
from lab.bed.ros import NODES
from lab.bench.trust import QUICK, _in_process
from rmpa.discovery.beacon import RUN_AT, Beacon
from rmpa.runtime.system_clock import SystemClock
from rmpa.trust.io.membership import Membership
from rmpa.trust.keyring import KeyPurpose
from rmpa.trust.packets import TRAILER_BYTES, Verdict
from rmpa.trust.preface import PREFACE_BYTES, PrefaceError
from rmpa.trust.reasons import TrustReason

if TYPE_CHECKING:
    from pathlib import Path
    from types import ModuleType


@pytest.fixture(scope="module")
def forger() -> ModuleType:
    """The node as a module; it is a program, started by its path."""
    sys.path.insert(0, str(NODES))
    spec = importlib.util.spec_from_file_location("forger_node", NODES / "forger.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.path.remove(str(NODES))
    return module


@pytest.fixture
def member(tmp_path: Path) -> Membership:
    return Membership.load(MeasuredMesh().admit(tmp_path, "host", "arm"), SystemClock(), time.time)


def test_members_of_the_bench_are_whole(member: Membership) -> None:
    assert member.name == "arm"
    assert member.wall() is not None


def test_a_forged_beacon_is_whole_but_for_its_tag(forger: ModuleType, member: Membership) -> None:
    packet = forger.beacon(7, "10.9.9.9")
    assert Beacon.parse(packet[:-TRAILER_BYTES], 0).identity.name == "forged"
    judged = member.packets.verifier.verify(packet, KeyPurpose.BEACON, RUN_AT, 1.0, time.time())
    assert judged.verdict is Verdict.FORGED


def test_a_forged_preface_is_whole_but_for_its_tag(forger: ModuleType, member: Membership) -> None:
    data = forger.preface()
    assert len(data) > PREFACE_BYTES
    with pytest.raises(PrefaceError) as caught:
        member.guard.admit(data, 1.0, time.time())
    assert caught.value.reason is TrustReason.KEY


def test_streams_alone_cost_more_with_tls(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lab.bench.trust._STREAMED", {65536: 100})
    handshakes, costs = _in_process(QUICK, MeasuredMesh())
    assert len(handshakes) == QUICK.handshakes
    plain, secured = costs[65536]
    assert secured > plain > 0
