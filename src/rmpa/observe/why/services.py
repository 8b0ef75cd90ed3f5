"""Why a service of a peer cannot be called here.

The stages::

    peer ─ link ─ server ─ policy there ─ offer ─ shown ─ graph ─ answer ─ calls
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.bridge import limits
from rmpa.observe.check import FAIL, OK, UNKNOWN, WARN, Check
from rmpa.observe.why.diagnosis import Diagnosis

if TYPE_CHECKING:
    from collections.abc import Iterator


class FarService(msgspec.Struct, frozen=True, kw_only=True):
    """What the serving side's agent answers.

    Attributes:
        node: The node of its module that provides the service; empty if none does.
        service: The service's name in its own graph.
        crosses: Whether policy over there lets it cross to the one that asks.
        rule: The rule that says so.
        refusal: Why its server did not answer its own agent's probe, or empty.
        near: A service over there of nearly this name, or empty.
    """

    node: str = ""
    service: str = ""
    crosses: bool = True
    rule: str = ""
    refusal: str = ""
    near: str = ""


@dataclass(frozen=True, slots=True)
class NearService:
    """What this side knows of a service of one peer.

    Args:
        wire: Its name over there.
        offered: Whether the peer has offered it.
        node: Its node over there.
        hidden: Why it is not shown here, or empty.
        registered: Whether a client that asks the local core is sent to it.
        answer: What a probe brought: its type and md5 sum; empty if it was refused.
        refusal: Why the probe was refused, or empty.
        calls: From here, so far.
        failed: Of these.
        problem: Of the last one that failed on our way.
        mismatch: What a client was told whose definition is another one, or empty.
    """

    wire: str = ""
    offered: bool = False
    node: str = ""
    hidden: str = ""
    registered: bool = False
    answer: str = ""
    refusal: str = ""
    calls: int = 0
    failed: int = 0
    problem: str = ""
    mismatch: str = ""


_NOTHING: Final = NearService()


def walk_service(
    begin: tuple[Check, ...],
    to: str,
    peer: str,
    service: str,
    near: NearService = _NOTHING,
    far: FarService | None = None,
    refusal: str = "",
) -> Diagnosis:
    """Walk all stages.

    Args:
        begin: Those of the peer and its link.
        to: This module.
        peer: The one that should provide it.
        service: Its name here.
        near: What is known here.
        far: What the peer's agent answered; ``None`` if it did not.
        refusal: Why it did not.
    """
    stages = list(begin)
    if begin[-1].level is not FAIL:
        for stage in _stages(peer, service, near, far, refusal):
            stages.append(stage)
            if stage.level is FAIL:
                break
    node = (far.node if far is not None else "") or near.node
    flows = stages[-1].level is not FAIL
    return Diagnosis(kind="service", name=service, peer=peer, to=to, node=node, flows=flows, stages=tuple(stages))


def _stages(peer: str, service: str, near: NearService, far: FarService | None, refusal: str) -> Iterator[Check]:
    yield from _there(peer, near.wire or service, near, far, refusal)
    if not near.offered:
        remedy = (
            f"if it stays so for more than {limits.RECONCILE_INTERVAL:g} s, it is a bug of ours: both logs, please"
        )
        yield Check("offer", FAIL, f"the offer of {peer} has not come here", remedy)
    yield Check("offer", OK, f"{peer} offers it")
    if near.hidden:
        yield Check("shown", FAIL, f"it is not shown here: {near.hidden}", _unhide(near.hidden))
    was = f" (its {near.wire})" if near.wire not in ("", service) else ""
    yield Check("shown", OK, f"it is {service} here{was}")
    if not near.registered:
        remedy = f"it is put there again within {limits.RECONCILE_INTERVAL:g} s; if not, the agent's log says why"
        yield Check("graph", FAIL, "the local core does not have it", remedy)
    yield Check("graph", OK, "the local core sends clients to it")
    yield _answer(peer, near)
    yield _calls(near)


def _there(peer: str, wire: str, near: NearService, far: FarService | None, refusal: str) -> Iterator[Check]:
    if far is None:
        verdict = UNKNOWN if near.offered else FAIL
        yield Check("server", verdict, f"{peer} does not tell ({refusal})", f"ask on {peer}: rosservice info {wire}")
        return
    if not far.node:
        remedy = f"did you mean {far.near}?" if far.near else f"start its server there (on {peer}: rosservice list)"
        yield Check("server", FAIL, f"no node of {peer} provides {wire}", remedy)
    was = f" as {far.service}" if far.service not in ("", wire) else ""
    if far.refusal:
        text = f"{far.node} on {peer} is registered for it, and does not answer: {far.refusal}"
        yield Check("server", FAIL, text, f"is it stopped, or dead? on {peer}: rosnode ping {far.node}")
    yield Check("server", OK, f"{far.node} on {peer} provides it{was}")
    if not far.crosses:
        remedy = f"change [services] or [[peer]] in the rmpa.toml of {peer}, and `rmpa reload` there"
        yield Check("policy there", FAIL, f"{peer} keeps it at home: {far.rule}", remedy)
    yield Check("policy there", OK, f"{peer} lets it cross: {far.rule}")


def _unhide(hidden: str) -> str:
    if hidden.startswith("policy"):
        return "change [services] or [[peer]] in this module's rmpa.toml, and `rmpa reload`"
    return "a graph has one provider for each service; give one of them another name (prefix or remap_in of [[peer]])"


def _answer(peer: str, near: NearService) -> Check:
    if near.answer:
        return Check("answer", OK, f"its server answers: {near.answer}")
    return Check(
        "answer", FAIL, near.refusal or "no answer", f"is the server on {peer} alive? its node's log may tell"
    )


def _calls(near: NearService) -> Check:
    text = f"{near.calls} from here, {near.failed} of them failed"
    if near.mismatch:
        return Check("calls", WARN, near.mismatch, "build both sides with one version of the service")
    if near.problem:
        return Check("calls", WARN, f"{text}; the last time: {near.problem}", "docs/services.md")
    return Check("calls", OK, text)
