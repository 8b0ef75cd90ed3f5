"""What came of reading the settings again: the answer of the control socket's ``reload``."""

from __future__ import annotations

import msgspec


class ReloadReply(msgspec.Struct, kw_only=True, frozen=True):
    """What the settings say now against what the agent runs with.

    Attributes:
        file: The file that was read, or empty if there is none.
        changed: The keys whose new values hold from now on (or would, for a check): ``bridge.deny``, ``[[peer]]``.
        restart: Those that only hold after a restart, each with both values: ``mesh.port (40001 instead of 0)``.
        notes: What is doubtful about the settings.
        problem: Why they cannot be used, with the file's line; then nothing has changed. Empty if they can.
    """

    file: str = ""
    changed: tuple[str, ...] = ()
    restart: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    problem: str = ""
