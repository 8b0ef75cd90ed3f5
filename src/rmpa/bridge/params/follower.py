"""The part of the bridge for parameters: answers peers, and keeps what is followed equal to its owners' values.

``[[param]]`` and ``[time]`` say what is followed.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rmpa.bridge import limits
from rmpa.bridge.params.owner import FOLLOW, VALUE, ParamCore, ParamOwner, follow_rules, read_text, text_of
from rmpa.bridge.policy import Needs
from rmpa.bridge.sessions import Part, PeerSession
from rmpa.config.rules import SIM_TIME, FollowRule, overlap
from rmpa.core.errors import RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.log import RefusalLog
from rmpa.runtime.tasks import end_tasks, start_task

if TYPE_CHECKING:
    from rmpa.bridge.bridge import Bridge
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Followed:
    """One followed parameter.

    Args:
        rule: Its owner, the owner's key, and the key here.
        peer: The number of the peer that it is followed from; ``None`` while its owner is not linked.
        last: ``peer`` of the last link: another run of the owner has another number.
        text: The owner's value as XML-RPC text; ``None`` if the owner has none, or it is unknown.
        known: Whether the owner's value, or its absence, is known.
        had: Whether this run of the owner has had a value. Before that, an absent value does not delete the one here.
        due: Whether the local core is to be compared with the owner's value, and set.
        told: Whether the owner's value has come since the last comparison; else what differs was changed here.
        doubted: Whether the local core has reported a change of it since the last comparison, or that has failed.
        problem: Why it is not followed, or empty.
    """

    rule: FollowRule
    peer: int | None = None
    last: int | None = None
    text: str | None = None
    known: bool = False
    had: bool = False
    due: bool = False
    told: bool = False
    doubted: bool = False
    problem: str = ""

    @property
    def state(self) -> str:
        """The state for the user: ``followed``, ``waiting`` (for the owner) or ``refused``."""
        if self.peer is None:
            return "waiting"
        return "refused" if self.problem else "followed" if self.known else "waiting"


class Params(Part):
    """The part of the bridge for parameters.

    Args:
        bridge: The core, the peers and the rules.

    Attributes:
        owner: This module's own parameters, for peers.
        followed: The parameters that this module follows, in the order of the rules.
        _time_before: What ``/use_sim_time`` was here before it was followed; empty if it was not followed.
        _renamed: Names under which values still stand that have another name since a reload.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._core = ParamCore(bridge.core, bridge.node)
        self.owner = ParamOwner(self._core, bridge)
        self.followed = [Followed(rule) for rule in follow_rules(bridge.context.settings)]
        self._refusals = RefusalLog(_log, bridge.counters)
        self._time_before: list[str | None] = []
        self._renamed: set[str] = set()
        self._asking: dict[int, asyncio.Task[None]] = {}
        self._working: asyncio.Task[None] | None = None
        self._looking: asyncio.Task[None] | None = None
        self._run: XmlRpcValue = None
        own = Needs((), "what `[[param]]` follows from this very peer")
        bridge.rpc.on_request(VALUE, self._told, own)

    def notes(self) -> tuple[str, ...]:
        """Messages to the user about parameters that are not followed although their owner is linked."""
        found = (entry for entry in self.followed if entry.problem and entry.peer is not None)
        return tuple(f"parameter {entry.rule} is not followed: {entry.problem}" for entry in found)

    def reload(self) -> None:
        """Apply other settings; parameters that they do not affect are not touched."""
        self.owner.judge_again()
        before = {entry.rule: entry for entry in self.followed}
        rules = follow_rules(self._bridge.context.settings)
        sources = {(rule.owner, rule.key): rule.to for rule in rules}
        self._renamed |= {
            rule.to
            for rule, entry in before.items()
            if entry.text is not None and sources.get((rule.owner, rule.key), rule.to) != rule.to
        }
        self.followed = [before.pop(rule, Followed(rule)) for rule in rules]
        gone = {rule.owner for rule in before}
        for session in self._bridge.sessions.linked():
            if self._claim(session) or session.link.name in gone:
                self._ask(session)

    def link_up(self, session: PeerSession) -> None:
        """Follow the parameters that a linked peer owns."""
        if self._claim(session):
            self._ask(session)

    def link_down(self, session: PeerSession) -> None:
        """Forget what the peer follows; the values of parameters that it owns stay.

        If another linked peer has its name, that one owns them now.
        """
        self.owner.link_down(session.peer)
        if (task := self._asking.pop(session.peer, None)) is not None:
            task.cancel()
        mine = [entry for entry in self.followed if entry.peer == session.peer]
        for entry in mine:
            entry.peer, entry.problem = None, ""
        for other in list(self._bridge.sessions.linked()):
            if other.peer != session.peer and any(entry.rule.owner == other.link.name for entry in mine):
                self.link_up(other)

    def param_update(self, key: str) -> bool:
        """Handle a notification of the local core that a parameter has changed; return whether it concerns us."""
        found = [entry for entry in self.followed if overlap(entry.rule.to, key)]
        for entry in found:
            entry.doubted = True
        return self.owner.touched(key) or bool(found)

    def reconcile(self) -> None:
        """Compare the values in the background, and mend differences."""
        if self._looking is None or self._looking.done():
            self._looking = start_task(self._look(), "look at parameters")

    async def close(self) -> None:
        """End all tasks, and unsubscribe from the local core, which may live on; the values stay there."""
        await end_tasks(self._looking, self._working, *self._asking.values(), *self.owner.tasks())
        with contextlib.suppress(RmpaError, TimeoutError):
            async with asyncio.timeout(limits.PARAM_LEAVE_TIMEOUT):
                await self._core.leave_others(set())

    async def _look(self) -> None:
        try:
            run = (await self._core.get("/run_id"))[1]
            restarted, self._run = self._run not in (None, run), run
            if restarted:
                self._core.subscribed.clear()
            await self._core.leave_others(self.owner.followed | {entry.rule.to for entry in self.followed})
            await self.owner.look(restarted=restarted)
            await self._compare_all(restarted=restarted)
        except UnreachableError:
            pass  # reported by the core itself
        except RmpaError as error:
            _log.warning("! parameters cannot be read: %s [param-trouble]", error)

    def _claim(self, session: PeerSession) -> bool:
        """Follow a linked peer's parameters that no other peer of its name owns; return whether there are any."""
        owned = [entry for entry in self.followed if entry.rule.owner == session.link.name]
        mine = [entry for entry in owned if entry.peer in (None, session.peer)]
        for entry in mine:
            entry.peer, entry.problem = session.peer, ""
            entry.had = entry.had and entry.last == session.peer
            entry.last = session.peer
        if len(mine) < len(owned):
            name = session.link.name
            text = f"two peers are named {name}; its parameters are followed from the one that came first"
            self._refuse("param.two_owners", name, text)
        return bool(mine)

    def _ask(self, session: PeerSession) -> None:
        if (asking := self._asking.get(session.peer)) is None or asking.done():
            name = f"follow parameters of {session.link.name}"
            self._asking[session.peer] = start_task(self._follow(session), name)

    async def _follow(self, session: PeerSession) -> None:
        mine = [entry for entry in self.followed if entry.peer == session.peer]
        keys = [entry.rule.key for entry in mine]
        try:
            answer = await self._bridge.rpc.request(session, FOLLOW, {"keys": keys})
            refused = answer.get("refused", {}) if isinstance(answer, dict) else {}
        except RmpaError as error:
            refused = dict.fromkeys(keys, str(error))
        for entry in mine:
            if entry.peer == session.peer and entry.rule.key in refused:
                self._refused(entry, str(refused[entry.rule.key]))

    def _refused(self, entry: Followed, why: str) -> None:
        entry.problem = why[: limits.CONTROL_TEXT_MAX]
        entry.known = False
        self._refuse("param.refused", str(entry.rule), f"{entry.rule} is not followed: {entry.problem}")

    def _told(self, session: PeerSession, args: dict[str, Any]) -> None:
        """Take the owner's value.

        If this run of the owner has never had one, the value here is kept; else the local core is to be set.
        """
        text, refused = args.get("text"), args.get("refused")
        if text is not None:
            text_of(args)
        for entry in self.followed:
            if (entry.peer, entry.rule.key) != (session.peer, args.get("key")):
                continue
            if refused is not None:
                self._refused(entry, str(refused))
                continue
            entry.problem, entry.text, entry.known = "", text, True
            entry.had = entry.had or text is not None
            entry.due = entry.told = entry.had
        self._work_soon()

    async def _compare_all(self, *, restarted: bool) -> None:
        """Put back what was changed here, and ask again for what was refused.

        Args:
            restarted: Whether the core was restarted: it has none of the values and subscriptions.
        """
        if self._time_before and all(entry.rule.to != SIM_TIME for entry in self.followed):
            await self._reset_time(self._time_before.pop())
        for key in {key for key in self._renamed if not any(overlap(entry.rule.to, key) for entry in self.followed)}:
            await self._core.delete(key)
        self._renamed.clear()
        for entry in list(self.followed):
            if restarted:
                entry.due = entry.told = entry.known and entry.had
            elif entry.doubted or len(entry.text or "") <= limits.PARAM_SMALL:
                entry.due = entry.known and entry.had
        refused = {entry.peer for entry in self.followed if not entry.known}
        for session in self._bridge.sessions.linked():
            if session.peer in refused:
                self._ask(session)
        self._work_soon()
        if self._working is not None:
            await asyncio.wait([self._working])

    async def _reset_time(self, text: str | None) -> None:
        """Set ``/use_sim_time`` as it was: with it and no clock a node that starts stands at time 0."""
        if text is None:
            await self._core.delete(SIM_TIME)
        else:
            await self._core.set(SIM_TIME, await read_text(text))
        _log.info("= %s is no longer followed, and as before: %s", SIM_TIME, "not set" if text is None else "set")

    def _work_soon(self) -> None:
        idle = self._working is None or self._working.done()
        if idle and any(entry.due for entry in self.followed):
            self._working = start_task(self._work(), "follow parameters")

    async def _work(self) -> None:
        """Set the values that are due; ``look`` tries again what failed."""
        while todo := [entry for entry in self.followed if entry.due]:
            for entry in todo:
                try:
                    await self._apply(entry)
                except RmpaError as error:
                    entry.problem = str(error)
                    text = f"{entry.rule} cannot be set as its owner has it: {error}"
                    self._refuse("param.failed", str(entry.rule), text)

    async def _apply(self, entry: Followed) -> None:
        """Set a value here, unless it is there already; a malformed text changes nothing."""
        text, key, told = entry.text, entry.rule.to, entry.told
        entry.due = entry.told = entry.doubted = False
        if sum(len(each.text or "") for each in self.followed) > limits.FOLLOWED_BYTES_MAX:
            entry.text, entry.known = None, False
            raise RemoteProtocolError(f"more than {limits.FOLLOWED_BYTES_MAX >> 20} MiB of parameters are followed")
        try:
            value = await read_text(text) if text is not None else None
            if key not in self._core.subscribed:
                await self._core.follow(key)
            if await self._bring(entry, value) and not told:
                text = f"{key} was changed here, and is put back: it belongs to {entry.rule.owner} ([[param]])"
                self._refuse("param.put_back", key, text)
        except RemoteProtocolError:
            entry.text, entry.known = None, False
            raise
        except RmpaError:
            entry.doubted = True
            entry.told = entry.told or told
            raise
        entry.problem = ""

    async def _bring(self, entry: Followed, value: XmlRpcValue) -> bool:
        """Make the local value equal to the owner's; return whether it was different."""
        key, text = entry.rule.to, entry.text
        here = await self._core.get_text(key)
        if key == SIM_TIME and not self._time_before:
            self._time_before.append(here)
        if here == text:
            return False
        if text is None:
            await self._core.delete(key)
        else:
            await self._core.set(key, value)
        _log.info("= %s: %s", entry.rule, f"{len(text)} characters" if text is not None else "deleted by its owner")
        return True

    def _refuse(self, kind: str, who: str, text: str) -> None:
        self._refusals.refuse(asyncio.get_running_loop().time(), kind, who, text)
