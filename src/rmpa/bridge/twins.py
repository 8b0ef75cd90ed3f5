"""Decides whether a peer is a *twin*: a module of the same kind, each of which drives the other by equal names. Pure.

Two identical robots offer the same topics (``/odom``, ``/scan``) and take the same commands (``/cmd_vel``). By
default one name is one topic in the whole mesh, so the command of one reaches both. In one robot that is split over
several modules a name is offered by one module, and taken by others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable
    from collections.abc import Set as AbstractSet

_NAMES_MIN: Final = 3
"""Names in common that make two modules twins."""
OFFERED_MIN: Final = 2
"""Of these, names that both offer: a driver and its driven have none, whatever passes between them."""
_NAMES_SHOWN: Final = 4
_COMMON: Final = frozenset({
    "/tf", "/tf_static", "/diagnostics", "/diagnostics_agg", "/diagnostics_toplevel_state", "/statistics",
    "/client_count", "/connected_clients", "/clock", "/rosout", "/rosout_agg",
})  # fmt: skip
"""Names that modules of every kind may share: transforms, diagnostics, time, logs, and those of common tools."""
_COMMON_ENDINGS: Final = (
    "/parameter_updates", "/parameter_descriptions", "/bond",
    "/quality", "/requirements", "/responses", "/observed", "/alarms", "/profile", "/context", "/state", "/decision",
    "/descriptor", "/set_context",
)  # fmt: skip
"""Ends of names of nodes' own interfaces: dynamic_reconfigure, nodelets, Smart Resources."""


def telling(names: Iterable[str]) -> frozenset[str]:
    """The names that tell something of the kind of a module: not those that all modules may share."""
    return frozenset(name for name in names if name not in _COMMON and not name.endswith(_COMMON_ENDINGS))


def twin_names(
    offered: AbstractSet[str], taken: AbstractSet[str], offered_there: AbstractSet[str], taken_there: AbstractSet[str]
) -> tuple[str, ...]:
    """The names that make a peer a twin, those first by which one drives the other; empty: it is none.

    All by their names here, and only telling ones.

    Args:
        offered: What this module's own nodes publish.
        taken: What they subscribe to.
        offered_there: What the peer's own nodes publish here.
        taken_there: What they subscribe to, as far as the peer said.
    """
    both = offered & offered_there
    driven = taken & (taken_there | offered_there)
    if len(both) < OFFERED_MIN or not driven or len(both | driven) < _NAMES_MIN:
        return ()
    return (*sorted(driven), *sorted(both - driven))


def twin_text(peer: str, names: tuple[str, ...]) -> str:
    """What the user is told of a twin, with what to do behind the semicolon."""
    more = len(names) - _NAMES_SHOWN
    shown = ", ".join(names[:_NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")
    return (
        f"its nodes offer and take the same names as ours ({shown}), so each module drives the other; start both "
        f'with rmpa up --prefix-peers, or write in rmpa.toml below [[peer]]: name = "{peer}" and prefix = "/{{peer}}"'
    )
