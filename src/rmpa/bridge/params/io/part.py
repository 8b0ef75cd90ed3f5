"""The part of the bridge for parameters across modules: requests, changes and followed values."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.params.io.core import ParamCore
from rmpa.bridge.params.io.follower import ParamFollower
from rmpa.bridge.params.io.param_owner import ParamOwner
from rmpa.bridge.params.rules import ParamPolicy, follow_rules
from rmpa.bridge.permission_gate import OPEN_GATE, PermissionGate
from rmpa.bridge.session.part import Part
from rmpa.config import limits as config_limits
from rmpa.core.errors import RmpaError, UnreachableError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.bridge.params.rules import Followed
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.config.settings import ParamSettings, Settings, TimeSettings
    from rmpa.core.counters import Counters
    from rmpa.ros.core.api import Core
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_log = logging.getLogger(__name__)


class Params(Part):
    """The part of the bridge for parameters.

    Args:
        core: The local core.
        node: The agent's own node, which the core notifies of changes.
        rpc: Carries the requests between the modules.
        linked: Returns the sessions of the peers that are linked now.
        counters: Counts ``param.put_back``, ``param.refused``, ``param.failed`` and ``param.two_owners``.
        params: What peers may do, and what is followed.
        time: Whether time is shared, and which peer's is followed.
        followed_max: How many parameters one peer may follow here.
        gate: Decides what each peer may do.
    """

    def __init__(
        self,
        core: Core,
        node: SlaveNode,
        rpc: PeerRpc,
        linked: Callable[[], Iterable[PeerSession]],
        counters: Counters,
        params: ParamSettings,
        time: TimeSettings,
        followed_max: int = config_limits.FOLLOWED_MAX,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        self._core = ParamCore(core, node)
        self._server = ParamOwner(self._core, ParamPolicy(params, time), rpc, followed_max, gate)
        self._follower = ParamFollower(self._core, rpc, linked, follow_rules(params, time), counters)
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

    def reload(self, settings: Settings) -> None:
        """Apply other settings; parameters that they do not affect are not touched."""
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
