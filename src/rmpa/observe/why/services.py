"""Why a service of a peer cannot be called here: the stages between the client and the server, in order.

The stages::

    peer ─ link ─ server ─ policy there ─ permission there ─ offer ─ shown (permission here) ─ graph ─ transport
         ─ answer ─ calls
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.bridge import limits
from rmpa.config.peer_rules import Access
from rmpa.observe.check import FAIL, OK, UNKNOWN, WARN, Check
from rmpa.observe.why.diagnosis import PERMISSION_THERE, Diagnosis, permission_here, permission_there, until_failure

if TYPE_CHECKING:
    from collections.abc import Iterator


class ServiceAtServer(msgspec.Struct, frozen=True, kw_only=True):
    """What the server's agent knows of a service; its answer to ``why.service``.

    Attributes:
        node: The node of its module that provides the service; empty if none does.
        service: The service's name in its own graph.
        crosses: Whether the policy of its module lets it cross to the agent that asks.
        rule: The rule that says so.
        refusal: Why the server did not answer its own agent's probe, or empty.
        similar: A service of that module with nearly this name, or empty; ``near`` on the wire.
        permitted: Whether the permissions of its module let the module that asks call it; ``None``: trust is off
            there. If not, nothing else is told, also not whether there is such a service.
    """

    node: str = ""
    service: str = ""
    crosses: bool = True
    rule: str = ""
    refusal: str = ""
    similar: str = msgspec.field(default="", name="near")
    permitted: bool | None = None


@dataclass(frozen=True, slots=True)
class ServiceTransport:
    """How the nodes of a module call a service of a peer.

    Args:
        wanted: The transport that the module's rules ask for.
        address: Where they call the server directly; empty if the calls are relayed.
        condition: The condition of direct transport that does not hold, in one word; empty if none is known.
        problem: That condition's fact.
    """

    wanted: str = "relay"
    address: str = ""
    condition: str = ""
    problem: str = ""


@dataclass(frozen=True, slots=True)
class ServiceAtClient:
    """What the clients' agent knows of a service of one peer.

    Args:
        wire: Its name at the peer.
        offered: Whether the peer has offered it.
        node: Its node at the peer.
        hidden: Why it is not shown here, or empty.
        denied: Whether that is a permission.
        registered: Whether the local core sends clients to it.
        transport: How the nodes of this module call it.
        answer: The type and md5 sum that a probe brought; empty if it was refused.
        refusal: Why the probe was refused, or empty.
        calls: The number of calls from here.
        failed: The number of these calls that failed.
        problem: Why the last one failed, if it did not reach the server.
        mismatch: The error that a client with another definition received, or empty.
    """

    wire: str = ""
    offered: bool = False
    node: str = ""
    hidden: str = ""
    denied: bool = False
    registered: bool = False
    transport: ServiceTransport = ServiceTransport()
    answer: str = ""
    refusal: str = ""
    calls: int = 0
    failed: int = 0
    problem: str = ""
    mismatch: str = ""


_NOTHING: Final = ServiceAtClient()


def diagnose_service(
    begin: tuple[Check, ...],
    to: str,
    peer: str,
    service: str,
    here: ServiceAtClient = _NOTHING,
    there: ServiceAtServer | None = None,
    refusal: str = "",
) -> Diagnosis:
    """Judge all stages.

    Args:
        begin: The stages of the peer and its link.
        to: This module.
        peer: The module that should provide it.
        service: Its name here.
        here: What is known here.
        there: What the peer's agent answered; ``None`` if it did not.
        refusal: Why the peer's agent did not answer.
    """
    stages = until_failure(chain(begin, _stages(peer, service, to, here, there, refusal)))
    node = (there.node if there is not None else "") or here.node
    return Diagnosis.of(stages, kind="service", name=service, peer=peer, to=to, node=node)


def _stages(
    peer: str, service: str, to: str, here: ServiceAtClient, there: ServiceAtServer | None, refusal: str
) -> Iterator[Check]:
    yield from _at_server(peer, here.wire or service, to, here, there, refusal)
    if not here.offered:
        remedy = (
            f"if it stays so for more than {limits.RECONCILE_INTERVAL:g} s, it is a bug of ours: both logs, please"
        )
        yield Check("offer", FAIL, f"the offer of {peer} has not come here", remedy)
    yield Check("offer", OK, f"{peer} offers it")
    if here.denied:
        yield permission_here(peer, Access.SERVE, service, here.hidden)
    if here.hidden:
        yield Check("shown", FAIL, f"it is not shown here: {here.hidden}", _unhide(here.hidden))
    was = f" (its {here.wire})" if here.wire not in ("", service) else ""
    yield Check("shown", OK, f"it is {service} here{was}")
    if not here.registered:
        remedy = f"it is put there again within {limits.RECONCILE_INTERVAL:g} s; if not, the agent's log says why"
        yield Check("graph", FAIL, "the local core does not have it", remedy)
    yield Check("graph", OK, "the local core sends clients to it")
    yield _transport(peer, here.transport)
    yield _answer(peer, here)
    yield _calls(here)


def _at_server(
    peer: str, wire: str, to: str, here: ServiceAtClient, there: ServiceAtServer | None, refusal: str
) -> Iterator[Check]:
    if there is None:
        level = UNKNOWN if here.offered else FAIL
        yield Check("server", level, f"{peer} does not tell ({refusal})", f"ask on {peer}: rosservice info {wire}")
        return
    if there.permitted is False:
        yield permission_there(peer, to, Access.CALL, wire)
    if not there.node:
        remedy = (
            f"did you mean {there.similar}?"
            if there.similar
            else f"start its server there (on {peer}: rosservice list)"
        )
        yield Check("server", FAIL, f"no node of {peer} provides {wire}", remedy)
    was = f" as {there.service}" if there.service not in ("", wire) else ""
    if there.refusal:
        text = f"{there.node} on {peer} is registered for it, and does not answer: {there.refusal}"
        yield Check("server", FAIL, text, f"is it stopped, or dead? on {peer}: rosnode ping {there.node}")
    yield Check("server", OK, f"{there.node} on {peer} provides it{was}")
    if not there.crosses:
        remedy = f"change [services] or [[peer]] in the rmpa.toml of {peer}, and `rmpa reload` there"
        yield Check("policy there", FAIL, f"{peer} keeps it at home: {there.rule}", remedy)
    yield Check("policy there", OK, f"{peer} lets it cross: {there.rule}")
    if there.permitted:
        yield Check(PERMISSION_THERE, OK, f"{peer} lets {to} call it")


def _unhide(hidden: str) -> str:
    if hidden.startswith("policy"):
        return "change [services] or [[peer]] in this module's rmpa.toml, and `rmpa reload`"
    return "a graph has one provider for each service; give one of them another name (prefix or remap_in of [[peer]])"


def _transport(peer: str, found: ServiceTransport) -> Check:
    if found.address:
        return Check("transport", OK, f"direct: clients call the server itself, at {found.address}")
    if found.wanted == "relay":
        return Check("transport", OK, 'relayed by both agents: transport is "relay" here')
    if not found.condition:
        return Check("transport", OK, f"relayed by both agents; {peer} is being asked for direct calls")
    if found.wanted == "direct" and found.condition != "transport":
        text = f'relayed although transport is "direct" ({found.condition}): {found.problem}'
        return Check("transport", WARN, text, "docs/services.md says what each condition needs")
    return Check("transport", OK, f"relayed by both agents ({found.condition}): {found.problem}")


def _answer(peer: str, here: ServiceAtClient) -> Check:
    if here.answer:
        return Check("answer", OK, f"its server answers: {here.answer}")
    return Check(
        "answer", FAIL, here.refusal or "no answer", f"is the server on {peer} alive? its node's log may tell"
    )


def _calls(here: ServiceAtClient) -> Check:
    text = f"{here.calls} from here, {here.failed} of them failed"
    if here.transport.address:
        text = f"{text}; direct ones are not counted"
    if here.mismatch:
        return Check("calls", WARN, here.mismatch, "build both sides with one version of the service")
    if here.problem:
        return Check("calls", WARN, f"{text}; the last time: {here.problem}", "docs/services.md")
    return Check("calls", OK, text)
