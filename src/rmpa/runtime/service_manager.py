"""Status notifications to systemd (sd_notify(3)): one datagram to NOTIFY_SOCKET, if it is set."""

from __future__ import annotations

import logging
import os
import socket

_log = logging.getLogger(__name__)


def notify_service_manager(state: str) -> bool:
    """Send ``READY=1``, ``STOPPING=1`` or ``STATUS=…``; a failure is logged and never fatal.

    Returns:
        Whether it was sent.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    if address.startswith("@"):
        address = "\0" + address[1:]
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock:
            sock.sendto(state.encode(), address)
    except OSError as error:
        _log.warning("the service manager at NOTIFY_SOCKET=%s cannot be told %s: %s", address, state, error)
        return False
    return True
