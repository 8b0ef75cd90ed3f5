"""The value of the control socket's operation ``reload``."""

from __future__ import annotations

import msgspec


class ReloadReply(msgspec.Struct, kw_only=True, frozen=True):
    """The settings as read again, against those that the agent runs with.

    Attributes:
        file: The file that was read, or empty if there is none.
        changed: The keys whose new values hold from now on (or would, for a check): ``bridge.deny``, ``[[peer]]``.
        restart: Those that hold after a restart only, each with both values: ``mesh.port (40001 instead of 0)``.
        notes: Doubtful settings, each ready to read.
        problem: Why the settings cannot be used, with the file's line, and nothing has changed; empty if they can.
    """

    file: str = ""
    changed: tuple[str, ...] = ()
    restart: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    problem: str = ""
