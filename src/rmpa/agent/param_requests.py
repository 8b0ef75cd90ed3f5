"""The control socket's words about parameters: a peer's, asked through its agent, and those that are followed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rmpa.bridge import limits
from rmpa.bridge.params.transfer import QUESTIONS
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError
from rmpa.observe.snapshot import FollowedInfo

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.bridge.params.io.part import Params
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession


class ParamOps:
    """Handlers of the control socket.

    Args:
        params: What is followed.
        asks: Carries questions to the peers.
        attached: Finds the linked peer that a user names; raises if there is none.
    """

    def __init__(self, params: Params, asks: PeerRpc, attached: Callable[[str], PeerSession]) -> None:
        self._params = params
        self._asks = asks
        self._attached = attached

    async def ask(self, args: dict[str, object]) -> Any:
        """Pass a question of ``bridge.params.transfer`` on to a peer: ``{peer, what, args}``."""
        what, inner = str(args.get("what", "")), args.get("args")
        if what not in QUESTIONS:
            near = did_you_mean(what, QUESTIONS)
            raise ConfigError("what", f"{what!r} is no question", f"did you mean {near}?" if near else "")
        if not isinstance(inner, dict):
            raise ConfigError("args", f"{inner!r} is no table")
        attached = self._attached(str(args.get("peer", "")))
        return await self._asks.ask(attached, what, inner, limits.PARAM_ASK_TIMEOUT)

    def followed(self, _args: dict[str, object]) -> tuple[FollowedInfo, ...]:
        """What this module follows, and how that goes."""
        return tuple(
            FollowedInfo(
                key=entry.rule.to,
                owner=entry.rule.owner,
                owner_key=entry.rule.key,
                state=entry.state,
                size=len(entry.text) if entry.text is not None else None,
                problem=entry.problem,
            )
            for entry in self._params.followed
        )
