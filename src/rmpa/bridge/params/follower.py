"""Keeps the parameters that this module follows equal to their owners' values (``[[param]]``, ``[time]``)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Any

from rmpa.bridge import limits
from rmpa.bridge.params import rules as transfer
from rmpa.bridge.params.owner import ParamCore, ParamOwner, read_text
from rmpa.bridge.params.rules import Following, ParamPolicy, follow_rules, learn
from rmpa.bridge.policy import Needs
from rmpa.bridge.sessions import Part
from rmpa.config.rules import SIM_TIME
from rmpa.core.counters import Counters, RefusalLog
from rmpa.core.errors import RemoteProtocolError, RmpaError, UnreachableError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.bridge.context import Shared
    from rmpa.bridge.params.rules import Followed
    from rmpa.bridge.rpc import PeerRpc
    from rmpa.bridge.sessions import PeerSession
    from rmpa.config.settings import FollowRule
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_log = logging.getLogger(__name__)


class ParamFollower:
    """The follower's side: parameters that other modules own.

    Args:
        core: The local core.
        rpc: Carries requests to the owners, and their notifications.
        linked: Returns the sessions of the peers that are linked now.
        rules: What is followed.
        counters: Counts ``param.put_back``, ``param.refused``, ``param.failed`` and ``param.two_owners``.
    """

    def __init__(
        self,
        core: ParamCore,
        rpc: PeerRpc,
        linked: Callable[[], Iterable[PeerSession]],
        rules: Iterable[FollowRule],
        counters: Counters,
    ) -> None:
        self._core = core
        self._rpc = rpc
        self._linked = linked
        self.following = Following(rules)
        self._refusals = RefusalLog(_log, counters)
        self._working: asyncio.Task[None] | None = None
        self._asking: dict[int, asyncio.Task[None]] = {}
        self.subscribed: set[str] = set()
        """The keys of which the local core notifies the agent's node."""
        self._time_before: list[str | None] = []
        """What ``/use_sim_time`` was here before it was followed; empty if it was not followed."""
        self._left: set[str] = set()
        rpc.on_notification(transfer.VALUE, self._told, Needs((), "what `[[param]]` follows from this very peer"))

    # --- events from the part ------------------------------------------------------------------------------------

    def link_up(self, session: PeerSession) -> None:
        """Follow the parameters that a linked peer owns."""
        mine, others = self.following.linked(session.peer, session.link.name)
        if others:
            text = (
                f"two peers are named {session.link.name}; its parameters are followed from the one that came first"
            )
            self._refuse("param.two_owners", session.link.name, text)
        if mine:
            self._ask(session)

    def link_down(self, peer: int) -> None:
        """Keep a peer's parameters as they are; if another linked peer has its name, that one owns them now."""
        task = self._asking.pop(peer, None)
        if task is not None:
            task.cancel()
        owners = {entry.rule.owner for entry in self.following.unlinked(peer)}
        for session in self._linked():
            if session.peer != peer and session.link.name in owners:
                self.link_up(session)

    def touched(self, key: str) -> bool:
        """Note a change of a local parameter, to be compared by ``look``.

        Returns:
            Whether it is a followed parameter, inside one, or a namespace around one.
        """
        found = self.following.touched(key)
        for entry in found:
            entry.doubted = True
        return bool(found)

    def change(self, rules: Iterable[FollowRule]) -> None:
        """Replace the rules, and send the new sets of keys to the owners that they concern."""
        gone, _ = self.following.change(rules)
        self._left |= {entry.rule.to for entry in gone}
        for session in self._linked():
            self.following.linked(session.peer, session.link.name)
            if any(session.link.name in (e.rule.owner for e in entries) for entries in (gone, self.following)):
                self._ask(session)

    async def look(self, *, restarted: bool) -> None:
        """Put back what was changed here, and ask again for what was refused.

        Args:
            restarted: Whether the core was restarted: it has none of the values and subscriptions.
        """
        for key in [key for key in self._left if all(key != entry.rule.to for entry in self.following)]:
            await self._core.leave(key)
            self.subscribed.discard(key)
            if key == SIM_TIME and self._time_before:
                await self._reset_time(self._time_before.pop())
        self._left.clear()
        if restarted:
            self.subscribed.clear()
        for entry in self.following:
            if restarted:
                entry.due = entry.known and (entry.text is not None or entry.had)
            elif entry.known and not entry.due and (entry.doubted or len(entry.text or "") <= limits.PARAM_SMALL):
                await self._compare(entry)
        refused = {entry.peer for entry in self.following if entry.peer is not None and not entry.known}
        for session in self._linked():
            if session.peer in refused:
                self._ask(session)
        self._work_soon()

    async def _reset_time(self, text: str | None) -> None:
        """Set ``/use_sim_time`` as it was: with it and no clock a node that starts stands at time 0."""
        if text is None:
            await self._core.delete(SIM_TIME)
        else:
            await self._core.set(SIM_TIME, await read_text(text))
        _log.info("= %s is no longer followed, and as before: %s", SIM_TIME, "not set" if text is None else "set")

    async def close(self) -> None:
        """Stop following; the values stay."""
        tasks = [*self._asking.values(), *([self._working] if self._working is not None else [])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    # --- the owners ----------------------------------------------------------------------------------------------

    def _ask(self, session: PeerSession) -> None:
        if session.peer in self._asking:
            return
        task = asyncio.create_task(self._follow(session), name=f"follow parameters of {session.link.name}")
        self._asking[session.peer] = task
        task.add_done_callback(lambda done: self._asked(session.peer, done))

    def _asked(self, peer: int, task: asyncio.Task[None]) -> None:
        if self._asking.get(peer) is task:
            del self._asking[peer]

    async def _follow(self, session: PeerSession) -> None:
        peer, name = session.peer, session.link.name
        keys = [entry.rule.key for entry in self.following if entry.peer == peer]
        try:
            answer = await self._rpc.request(session, transfer.FOLLOW, {"keys": keys})
            refused = answer.get("refused", {}) if isinstance(answer, dict) else {}
        except RmpaError as error:
            refused = dict.fromkeys(keys, str(error))
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! following parameters of %s failed", name)
            return
        for entry in self.following:
            if entry.peer == peer and entry.rule.key in refused:
                self._refused(entry, str(refused[entry.rule.key]))

    def _refused(self, entry: Followed, why: str) -> None:
        entry.problem = why[: limits.CONTROL_TEXT_MAX]
        entry.known = False
        self._refuse("param.refused", str(entry.rule), f"{entry.rule} is not followed: {entry.problem}")

    def _told(self, session: PeerSession, args: dict[str, Any]) -> None:
        key, exists, text, refused = (args.get(name) for name in ("key", "exists", "text", "refused"))
        if not isinstance(key, str) or not (text is None or isinstance(text, str)):
            raise RemoteProtocolError("news of a parameter without its key, or with a value that is no text")
        if refused is not None:
            for entry in self.following:
                if entry.peer == session.peer and entry.rule.key == key:
                    self._refused(entry, str(refused))
            return
        for entry in self.following.told(session.peer, key, exists=bool(exists), text=text):
            entry.problem = ""
        self._work_soon()

    # --- the local core ------------------------------------------------------------------------------------------

    def _work_soon(self) -> None:
        if self._working is None and any(entry.ask or entry.due for entry in self.following):
            self._working = asyncio.create_task(self._work(), name="follow parameters")

    async def _work(self) -> None:
        """Request large values, and set the values that are due; ``look`` tries again what failed."""
        failed: set[FollowRule] = set()
        try:
            while todo := [e for e in self.following if (e.ask or e.due) and e.rule not in failed]:
                for entry in todo:
                    try:
                        if entry.ask:
                            await self._read(entry)
                        if entry.due:
                            await self._apply(entry)
                    except RmpaError as error:
                        failed.add(entry.rule)
                        entry.problem = str(error)
                        self._refuse("param.failed", str(entry.rule), f"{entry.rule} is not as over there: {error}")
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! following parameters failed")
        finally:
            self._working = None

    async def _read(self, entry: Followed) -> None:
        session = next((one for one in self._linked() if one.peer == entry.peer), None)
        entry.ask = False
        if session is None:
            return
        args, news = {"key": entry.rule.key}, entry.news
        try:
            answer = await self._rpc.request(session, transfer.GET, args, limits.PARAM_ASK_TIMEOUT)
            text = transfer.text_of(answer)
        except RmpaError:
            entry.ask = entry.peer is not None  # if its owner has deleted it meanwhile, a notification follows
            raise
        if entry.news != news or entry.peer != session.peer:
            return  # it has changed again since
        learn(entry, text)

    async def _apply(self, entry: Followed) -> None:
        """Set a value here, unless it is there already; a malformed text changes nothing."""
        text, key = entry.text, entry.rule.to
        entry.due = False
        if self.following.size > limits.FOLLOWED_BYTES_MAX:
            entry.text, entry.known = None, False
            raise RemoteProtocolError(f"more than {limits.FOLLOWED_BYTES_MAX >> 20} MiB of parameters are followed")
        try:
            value = await read_text(text) if text is not None else None
            if key not in self.subscribed:
                await self._core.follow(key)
                self.subscribed.add(key)
            await self._bring(entry, value)
        except RemoteProtocolError:
            entry.text, entry.known = None, False
            raise
        except RmpaError:
            entry.due = True
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
        _log.info("= %s: %s", entry.rule, f"{len(text)} characters" if text is not None else "deleted over there")
        return True

    async def _compare(self, entry: Followed) -> None:
        """Put back, and log, a followed parameter that a local node has changed."""
        if entry.text is None and not entry.had:
            return
        entry.doubted = False
        try:
            value = await read_text(entry.text) if entry.text is not None else None
            if await self._bring(entry, value):
                text = (
                    f"{entry.rule.to} was changed here, and is put back: it belongs to {entry.rule.owner} ([[param]])"
                )
                self._refuse("param.put_back", entry.rule.to, text)
        except RmpaError as error:
            entry.doubted = True
            self._refuse("param.failed", str(entry.rule), f"{entry.rule} cannot be put back: {error}")

    def _refuse(self, kind: str, who: str, text: str) -> None:
        self._refusals.refuse(asyncio.get_running_loop().time(), kind, who, text)


# The part of the bridge for parameters across modules: requests, changes and followed values.


class Params(Part):
    """The part of the bridge for parameters.

    Args:
        shared: The core, the peers and the rules.
    """

    def __init__(self, shared: Shared) -> None:
        self._shared = shared
        settings, rpc = shared.context.settings, shared.rpc
        params, time, most, gate = settings.params, settings.time, settings.limits.params, shared.context.gate
        self._core = ParamCore(shared.core, shared.node)
        self._server = ParamOwner(self._core, ParamPolicy(params, time), rpc, most, gate)
        rules = follow_rules(params, time)
        self._follower = ParamFollower(self._core, rpc, shared.sessions.linked, rules, shared.counters)
        self._looking: asyncio.Task[None] | None = None
        self._run: XmlRpcValue = None

    @property
    def followed(self) -> Iterable[Followed]:
        """The parameters that this module follows, with the state of each."""
        return self._follower.following

    def notes(self) -> tuple[str, ...]:
        """Messages to the user about parameters that are not followed although their owner is linked."""
        found = (e for e in self._follower.following if e.problem and e.peer is not None)
        return tuple(f"parameter {entry.rule} is not followed: {entry.problem}" for entry in found)

    def reload(self) -> None:
        """Apply other settings; parameters that they do not affect are not touched."""
        settings = self._shared.context.settings
        params, time = settings.params, settings.time
        self._server.policy = ParamPolicy(params, time)
        self._server.followed_max = settings.limits.params
        self._server.judge_again()
        self._follower.change(follow_rules(params, time))

    def link_up(self, session: PeerSession) -> None:
        """Follow the parameters that a linked peer owns."""
        self._follower.link_up(session)

    def link_down(self, session: PeerSession) -> None:
        """Forget what the peer follows; the values of parameters that it owns stay."""
        self._server.link_down(session.peer)
        self._follower.link_down(session.peer)

    def param_update(self, key: str) -> bool:
        """Handle a notification of the local core that a parameter has changed."""
        return any((self._server.touched(key), self._follower.touched(key)))

    def reconcile(self) -> None:
        """Compare the values in the background, and mend differences."""
        if self._looking is None:
            self._looking = asyncio.create_task(self._look(), name="look at parameters")

    async def close(self) -> None:
        """End all tasks, and unsubscribe from the local core, which may live on; the values stay there."""
        if self._looking is not None:
            self._looking.cancel()
            await asyncio.gather(self._looking, return_exceptions=True)
        await self._server.close()
        await self._follower.close()
        with contextlib.suppress(RmpaError, TimeoutError):
            async with asyncio.timeout(limits.PARAM_LEAVE_TIMEOUT):
                for key in {*self._server.followed, *self._follower.subscribed}:
                    await self._core.leave(key)

    async def _look(self) -> None:
        try:
            run = await self._core.run_id()
            restarted, self._run = self._run not in (None, run), run
            await self._server.look(restarted=restarted)
            await self._follower.look(restarted=restarted)
        except UnreachableError:
            pass  # reported by the core itself
        except RmpaError as error:
            _log.warning("! parameters cannot be looked at: %s", error)
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! looking at parameters failed")
        finally:
            self._looking = None
