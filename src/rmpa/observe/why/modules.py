"""Why a module is reached or not: the stages from its beacon to what crosses its link, in order.

Pure: the snapshot of this agent, and what the peer's agent tells of itself, go in; stages come out::

    peer ─ link ─ path ─ lanes ─ answer ─ clock ─ load ─ limits ─ offers
"""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Final

from rmpa.observe.check import OK, UNKNOWN, WARN, Check
from rmpa.observe.doctor.machine import judge_peer_clock
from rmpa.observe.why.diagnosis import Diagnosis, until_failure
from rmpa.observe.why.topics import find_peer, peer_stages

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.observe.peer_agent import PeerAgent
    from rmpa.observe.peer_info import LinkInfo, PeerInfo
    from rmpa.observe.snapshot import Snapshot

_BUSY: Final = 90.0
"""Percent of a core from which on an agent counts as busy: it has one thread for all messages."""
_FILES: Final = 0.9
"""Share of its file descriptors from which on an agent is warned of."""


def diagnose_module(snapshot: Snapshot, name: str, told: PeerAgent | None = None, refusal: str = "") -> Diagnosis:
    """Judge all stages for one module.

    Args:
        snapshot: This agent's.
        name: The module's name or GUID.
        told: What its agent tells of itself; ``None`` if it did not.
        refusal: Why it did not, ready to read.
    """
    own = snapshot.agent
    if name in (own.name, own.guid, own.guid.partition("#")[0]):
        here = Check("peer", OK, f"{own.name} is this module ({own.guid}); its agent has answered")
        return Diagnosis.of((here,), name=own.name, peer=own.name, to=own.name, kind="module")
    peer = find_peer(snapshot, name)
    stages = peer_stages(snapshot, name)
    if peer is not None:
        stages = until_failure(chain(stages, _further(snapshot, peer, told, refusal)))
    shown = peer.name if peer is not None else name
    return Diagnosis.of(stages, name=shown, peer=shown, to=own.name, kind="module")


def _further(snapshot: Snapshot, peer: PeerInfo, told: PeerAgent | None, refusal: str) -> Iterator[Check]:
    link = peer.link
    if link is not None:
        yield from _lanes(link)
        yield _answer(peer, snapshot.agent.version, told, refusal)
        if link.clock_offset is not None:
            yield judge_peer_clock(snapshot.agent.name, peer.name, link.clock_offset, link.clock_error)
        if told is not None:
            yield from _load(peer.name, told)
    for bound in peer.beyond:
        yield Check.from_message("limits", WARN, bound.text)
    text = f"{peer.name} offers {peer.topics_in} topics, and is offered {peer.topics_out}"
    if peer.topics_in or peer.state == "relayed":
        yield Check("offers", OK, text)
    else:
        remedy = f"does a node of {peer.name} publish anything? Its [bridge] rules, and the ones here, may deny it"
        yield Check("offers", WARN, text, remedy)


def _lanes(link: LinkInfo) -> Iterator[Check]:
    for lane in link.lanes:
        if not lane.connected and not lane.unneeded:
            text = f"the {lane.name} lane has no connection: {lane.queued} bytes wait"
            yield Check("lanes", WARN, text, "it is dialled again by itself; is a firewall between the modules?")
    if link.dropped:
        text = f"{link.dropped} messages were dropped, because the link is slower than what it should carry"
        yield Check("lanes", WARN, text, "contracts with max_rate or priority say what may be left out")
    elif all(lane.connected for lane in link.lanes):
        yield Check("lanes", OK, f"{len(link.lanes) or 'all'} lanes are connected, nothing was dropped")
    elif all(lane.connected or lane.unneeded for lane in link.lanes):
        idle = ", ".join(lane.name for lane in link.lanes if not lane.connected)
        yield Check("lanes", OK, f"nothing was dropped; the {idle} lane is connected when a message wants it")


def _answer(peer: PeerInfo, version: str, told: PeerAgent | None, refusal: str) -> Check:
    if told is None:
        return Check(
            "answer", UNKNOWN, f"the agent of {peer.name} does not tell about itself: {refusal or 'not asked'}"
        )
    if told.version != version:
        text = f"its agent answers, and is of version {told.version or '?'}; this one is of {version}"
        return Check("answer", WARN, text, "install the same release on both, if something does not work")
    return Check("answer", OK, f"its agent answers, and is of version {told.version}, as this one")


def _load(name: str, told: PeerAgent) -> Iterator[Check]:
    if told.cpu is not None and told.cpu >= _BUSY:
        text = f"the agent of {name} uses {told.cpu:.0f} % of a core: messages wait"
        yield Check(
            "load", WARN, text, "`rmpa topic hz` there shows what is so much; direct transport relieves agents"
        )
    elif told.cpu is not None:
        yield Check("load", OK, f"the agent of {name} uses {told.cpu:.0f} % of a core")
    if told.files_open is not None and told.files_limit and told.files_open >= _FILES * told.files_limit:
        text = f"the agent of {name} has {told.files_open} of {told.files_limit} files open"
        yield Check("files", WARN, text, "raise its limit: ulimit -n, or LimitNOFILE of its service")
