"""What the user is told at the start about settings of permissions that do not do what they seem to."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.core.contract import Transport

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.config.settings import Settings


def permission_notes(settings: Settings, *, secured: bool) -> Iterator[str]:
    """The warnings, each ready to read.

    Args:
        settings: The agent's.
        secured: Whether this module is a member of a secured mesh.
    """
    if not secured and (settings.trust.rules or settings.trust.groups):
        yield (
            "[[permission]] has no effect: this module has not joined a secured mesh, so every peer may do all; "
            "`rmpa trust init` begins one, `rmpa trust join` enters one"
        )
    if secured and not settings.trust.direct and (asked := _asking_for_direct(settings)):
        yield (
            f'{" and ".join(asked)} ask for transport "direct", which a secured mesh has on one machine only, for '
            "nothing protects these connections: they are relayed; trust.direct = true in both modules allows them"
        )


def _asking_for_direct(settings: Settings) -> list[str]:
    """The settings that say ``direct``."""
    asked = [] if settings.transport is not Transport.DIRECT else ["bridge.transport"]
    if any(rule.values.get("transport") == Transport.DIRECT for rule in settings.contracts):
        asked.append("[[contract]]")
    rules = settings.services.rules
    if settings.services.transport is Transport.DIRECT or any(rule.transport is Transport.DIRECT for rule in rules):
        asked.append("[services]")
    return asked
