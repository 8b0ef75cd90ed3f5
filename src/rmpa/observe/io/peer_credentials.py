"""The user at the other end of a UNIX socket, as the kernel knows it, and the users that are served."""

from __future__ import annotations

import grp
import os
import socket
import struct
from dataclasses import dataclass
from typing import Final

from rmpa.core.errors import StartError

_UCRED: Final = struct.Struct("3i")
"""``struct ucred``: pid, uid, gid (unix(7), SO_PEERCRED)."""
_SO_PEERGROUPS: Final = 59
"""Not in Python's ``socket``; Linux has it since 4.13."""
_GROUPS_MAX: Final = 256
"""Groups of one user that are read, besides the main one: Python reads no more bytes. Of a user in more of them the
main one alone counts."""


@dataclass(frozen=True, slots=True)
class PeerCredentials:
    """The user of a client, at the time of its ``connect``.

    Attributes:
        pid: Its process; 0 if that is in another namespace.
        uid: Its effective user.
        groups: All groups of that user's process.
    """

    pid: int
    uid: int
    groups: frozenset[int]


def peer_credentials(sock: socket.socket) -> PeerCredentials:
    """The user at the other end.

    Raises:
        OSError: The socket is not a connected UNIX socket.
    """
    pid, uid, gid = _UCRED.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))
    try:
        raw = sock.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, 4 * _GROUPS_MAX)
    except OSError:
        raw = b""
    return PeerCredentials(pid, uid, frozenset({gid, *(each for (each,) in struct.iter_unpack("I", raw))}))


@dataclass(frozen=True, slots=True)
class ControlAccess:
    """The users that a control socket serves: the agent's own, root, and those of one group.

    Args:
        uid: The agent's user.
        group: The number of the group; ``None`` for none.
    """

    uid: int
    group: int | None = None

    def allows(self, user: PeerCredentials) -> bool:
        """Whether a user is served."""
        return user.uid in {0, self.uid} or (self.group is not None and self.group in user.groups)


def control_access(group: str) -> ControlAccess:
    """Who is served by an agent of this process's user.

    Args:
        group: A group's name or number, which this user must be in; empty for none.

    Raises:
        StartError: There is no such group.
    """
    if not group:
        return ControlAccess(os.geteuid())
    try:
        number = int(group) if group.isdecimal() else grp.getgrnam(group).gr_gid
    except KeyError:
        remedy = f"make it (sudo groupadd {group}), or change group of [control]"
        raise StartError("control.group", f"there is no group {group!r}", remedy) from None
    return ControlAccess(os.geteuid(), number)
