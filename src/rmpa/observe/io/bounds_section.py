"""What is beyond ``[limits]``, as a user reads it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.observe.snapshot import BoundInfo

if TYPE_CHECKING:
    from rmpa.bridge.catalogue.bounds import Beyond

_DENY = {"services": "services.deny"}


def bound_here(peer: str, beyond: Beyond) -> BoundInfo:
    """What of a peer is hidden here."""
    text = (
        f"{beyond.what} of {peer} stay hidden here: it has more than {_setting(beyond)} of this module; "
        f"raise it in rmpa.toml and `rmpa reload`, or deny some by {_deny(beyond)}"
    )
    return _info(beyond, text, here=True)


def bound_there(peer: str, beyond: Beyond) -> BoundInfo:
    """What of ours is hidden at a peer."""
    text = (
        f"{beyond.what} of this module stay hidden at {peer}: there are more than {_setting(beyond)} over there; "
        f"raise it in its rmpa.toml and `rmpa reload` there, or deny some here by {_deny(beyond)}"
    )
    return _info(beyond, text, here=False)


def own_text(beyond: Beyond) -> str:
    """What of ours is offered to no peer."""
    return (
        f"{beyond.what} of this module are offered to no peer: more than {_setting(beyond)}; raise it "
        f"in rmpa.toml and `rmpa reload`, or deny some by {_deny(beyond)}"
    )


def _setting(beyond: Beyond) -> str:
    return f"limits.{beyond.kind} = {beyond.limit}"


def _deny(beyond: Beyond) -> str:
    return _DENY.get(beyond.kind, "bridge.deny")


def _info(beyond: Beyond, text: str, *, here: bool) -> BoundInfo:
    return BoundInfo(kind=beyond.kind, limit=beyond.limit, hidden=beyond.hidden, here=here, text=text)
