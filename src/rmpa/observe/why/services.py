"""Why a service of a peer cannot be called here, and why a module is reached or not: their stages, in order.

Pure. Of a service, between the client and the server::

    peer ─ link ─ server ─ policy there ─ permission there ─ offer ─ shown (permission here) ─ graph ─ transport
         ─ answer ─ calls

Of a module, from its beacon to what crosses its link::

    peer ─ link ─ lanes ─ answer ─ clock ─ load ─ limits ─ offers
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.config.peer_rules import Access
from rmpa.core.identity import is_meant
from rmpa.observe.check import FAIL, OK, UNKNOWN, WARN, Check
from rmpa.observe.snapshot import ModuleFacts, PeerInfo, Snapshot
from rmpa.observe.why.diagnosis import (
    PERMISSION_THERE,
    Diagnosis,
    judge_peer_clock,
    permission_here,
    permission_there,
    until_failure,
)
from rmpa.observe.why.stages import find_peer, peer_stages

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.core.facts import LinkInfo, ServiceInfo
    from rmpa.observe.why.diagnosis import ServiceAtServer

# Percent of a core from which on an agent counts as busy: it has one thread for all messages.
_BUSY: Final = 90.0
# Share of its file descriptors from which on an agent is warned of.
_FILES: Final = 0.9


@dataclass(frozen=True, slots=True)
class ServiceHere:
    """What the clients' agent knows of a service of one peer.

    Args:
        info: As in the snapshot; ``None``: the peer has not offered it.
        denied: Whether a permission hides it.
        registered: Whether the local core sends clients to it.
        answer: The type and md5 sum that a probe brought; empty if it was refused.
        refusal: Why the probe was refused, or empty.
        mismatched: Whether the service's ``problem`` is that a client has another definition.
    """

    info: ServiceInfo | None = None
    denied: bool = False
    registered: bool = False
    answer: str = ""
    refusal: str = ""
    mismatched: bool = False


def diagnose_service(
    begin: tuple[Check, ...],
    to: str,
    peer: str,
    service: str,
    wire: str = "",
    here: ServiceHere = ServiceHere(),
    there: ServiceAtServer | None = None,
    refusal: str = "",
) -> Diagnosis:
    """Judge all stages.

    Args:
        begin: The stages of the peer and its link.
        to: This module.
        peer: The module that should provide it.
        service: Its name here.
        wire: Its name at the peer.
        here: What is known here.
        there: What the peer's agent answered; ``None`` if it did not.
        refusal: Why the peer's agent did not answer.
    """
    stages = chain(
        begin, _at_server(peer, wire, to, here, there, refusal), _at_client(peer, service, wire, here.info, here)
    )
    node = (there.node if there is not None else "") or (here.info.node if here.info is not None else "")
    return Diagnosis.of(until_failure(stages), kind="service", name=service, peer=peer, to=to, node=node)


def _at_server(
    peer: str, wire: str, to: str, here: ServiceHere, there: ServiceAtServer | None, refusal: str
) -> Iterator[Check]:
    if there is None:
        level = UNKNOWN if here.info is not None else FAIL
        yield Check("server", level, f"{peer} does not tell ({refusal})", f"ask on {peer}: rosservice info {wire}")
        return
    if there.permitted is False:
        yield permission_there(peer, to, Access.CALL, wire)
    if not there.node:
        remedy = f"start its server there (on {peer}: rosservice list)"
        remedy = f"did you mean {there.similar}?" if there.similar else remedy
        yield Check("server", FAIL, f"no node of {peer} provides {wire}", remedy)
    if there.refusal:
        text = f"{there.node} on {peer} is registered for it, and does not answer: {there.refusal}"
        yield Check("server", FAIL, text, f"is it stopped, or dead? on {peer}: rosnode ping {there.node}")
    was = f" as {there.service}" if there.service not in ("", wire) else ""
    yield Check("server", OK, f"{there.node} on {peer} provides it{was}")
    if not there.crosses:
        remedy = f"change [services] or [[peer]] in the rmpa.toml of {peer}, and `rmpa reload` there"
        yield Check("policy there", FAIL, f"{peer} does not let it cross: {there.rule}", remedy)
    yield Check("policy there", OK, f"{peer} lets it cross: {there.rule}")
    if there.permitted:
        yield Check(PERMISSION_THERE, OK, f"{peer} lets {to} call it")


def _at_client(peer: str, service: str, wire: str, info: ServiceInfo | None, here: ServiceHere) -> Iterator[Check]:
    if info is None:
        wait = f"if it stays so for more than {limits.RECONCILE_INTERVAL:g} s"
        text = f"the offer of {peer} has not come here"
        yield Check("offer", FAIL, text, f"{wait}, it is a bug of ours: both logs, please")
        return
    yield Check("offer", OK, f"{peer} offers it")
    if here.denied:
        yield permission_here(peer, Access.SERVE, service, info.hidden)
    if info.hidden:
        remedy = "change [services] or [[peer]] in this module's rmpa.toml, and `rmpa reload`"
        if not info.hidden.startswith("policy"):
            remedy = "a graph has one provider for each service; "
            remedy += "give one of them another name (prefix or remap_in of [[peer]])"
        yield Check("shown", FAIL, f"it is not shown here: {info.hidden}", remedy)
    yield Check("shown", OK, f"it is {service} here{f' (its {wire})' if wire not in ('', service) else ''}")
    if not here.registered:
        again = f"it is put there again within {limits.RECONCILE_INTERVAL:g} s"
        yield Check("graph", FAIL, "the local core does not have it", f"{again}; if not, the agent's log says why")
    yield Check("graph", OK, "the local core sends clients to it")
    yield _transport(peer, info)
    if here.answer:
        yield Check("answer", OK, f"its server answers: {here.answer}")
    else:
        remedy = f"is the server on {peer} alive? see the log of its node"
        yield Check("answer", FAIL, here.refusal or "no answer", remedy)
    text = f"{info.calls} from here, {info.failed} of them failed"
    text += "; direct ones are not counted" if info.address else ""
    if here.mismatched:
        yield Check("calls", WARN, info.problem, "build both sides with one version of the service")
    elif info.problem:
        yield Check("calls", WARN, f"{text}; the last time: {info.problem}", "docs/guides/services.md#services")
    else:
        yield Check("calls", OK, text)


def _transport(peer: str, info: ServiceInfo) -> Check:
    if info.address:
        return Check("transport", OK, f"direct: clients call the server itself, at {info.address}")
    if info.wanted == "relay":
        return Check("transport", OK, 'relayed by both agents: the setting transport = "relay" here asks for it')
    if not info.condition:
        return Check("transport", OK, f"relayed by both agents; {peer} is being asked for direct calls")
    if info.wanted == "direct" and info.condition != "transport":
        text = f'relayed although transport is "direct" ({info.condition}): {info.relayed_because}'
        return Check("transport", WARN, text, "docs/guides/services.md#services says what each condition needs")
    return Check("transport", OK, f"relayed by both agents ({info.condition}): {info.relayed_because}")


def diagnose_module(snapshot: Snapshot, name: str, told: ModuleFacts | None = None, refusal: str = "") -> Diagnosis:
    """Judge all stages for one module.

    Args:
        snapshot: This agent's.
        name: The module's name or GUID.
        told: What its agent tells of itself; ``None`` if it did not.
        refusal: Why it did not, ready to read.
    """
    own, peer = snapshot.agent, find_peer(snapshot, name)
    shown, stages = peer.name if peer is not None else name, peer_stages(snapshot, name)
    if is_meant(name, own.name, own.guid):
        answered = Check("peer", OK, f"{own.name} is this module ({own.guid}); its agent has answered")
        shown, stages = own.name, (answered,)
    elif peer is not None:
        stages = until_failure(chain(stages, _module(snapshot, peer, told, refusal)))
    return Diagnosis.of(stages, name=shown, peer=shown, to=own.name, kind="module")


def _module(snapshot: Snapshot, peer: PeerInfo, told: ModuleFacts | None, refusal: str) -> Iterator[Check]:
    link, name, version = peer.link, peer.name, snapshot.agent.version
    if link is not None:
        yield from _lanes(link)
        if told is None:
            text = f"the agent of {name} does not tell about itself: {refusal or 'not asked'}"
            yield Check("answer", UNKNOWN, text)
        elif told.version != version:
            text = f"its agent answers, and is of version {told.version or '?'}; this one is of {version}"
            yield Check("answer", WARN, text, "install the same release on both, if something does not work")
        else:
            yield Check("answer", OK, f"its agent answers, and is of version {told.version}, as this one")
        if link.clock_offset is not None:
            yield judge_peer_clock(snapshot.agent.name, name, link.clock_offset, link.clock_error)
        yield from _load(name, told or ModuleFacts())
    for bound in peer.beyond:
        yield Check.from_message("limits", WARN, bound.text)
    text = f"{name} offers {peer.topics_in} topics, and is offered {peer.topics_out}"
    if peer.topics_in or peer.state == "relayed":
        yield Check("offers", OK, text)
    else:
        remedy = f"does a node of {name} publish anything? Its [bridge] rules, and the ones here, may deny it"
        yield Check("offers", WARN, text, remedy)


def _lanes(link: LinkInfo) -> Iterator[Check]:
    idle = [lane.name for lane in link.lanes if not lane.connected and lane.unneeded]
    cut = [lane for lane in link.lanes if not lane.connected and not lane.unneeded]
    for lane in cut:
        text = f"the {lane.name} lane has no connection: {lane.queued} bytes wait"
        yield Check("lanes", WARN, text, "it is dialled again by itself; is a firewall between the modules?")
    if link.dropped:
        text = f"{link.dropped} messages were dropped, because the link is slower than what it should carry"
        yield Check("lanes", WARN, text, "contracts with max_rate or priority say what may be left out")
    elif idle and not cut:
        text = f"nothing was dropped; the {', '.join(idle)} lane is connected when a message wants it"
        yield Check("lanes", OK, text)
    elif not cut:
        yield Check("lanes", OK, f"{len(link.lanes) or 'all'} lanes are connected, nothing was dropped")


def _load(name: str, told: ModuleFacts) -> Iterator[Check]:
    if told.cpu is not None:
        text = f"the agent of {name} uses {told.cpu:.0f} % of a core"
        remedy = "`rmpa topic hz` there shows what is so much; direct transport relieves agents"
        busy = Check("load", WARN, f"{text}: messages wait", remedy)
        yield busy if told.cpu >= _BUSY else Check("load", OK, text)
    if (files := told.files) is not None and files.open >= _FILES * files.limit:
        text = f"the agent of {name} has {files.open} of {files.limit} files open"
        yield Check("files", WARN, text, "raise its limit: ulimit -n, or LimitNOFILE of its service")
