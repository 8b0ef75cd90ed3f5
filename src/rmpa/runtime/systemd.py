"""What a service has beside its work: its log, the unit that runs it, and systemd's notifications (sd_notify(3)).

The log is written in a thread, so that one that is not read does not block the service.

A notification is one datagram to NOTIFY_SOCKET, if it is set.
"""

from __future__ import annotations

import faulthandler
import logging
import os
import re
import socket
import threading
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.runtime import limits

if TYPE_CHECKING:
    from asyncio import AbstractEventLoop
    from collections.abc import Mapping

_log = logging.getLogger(__name__)

# The agent's unit, as ``rmpa service install`` and the Debian package name it.
UNIT: Final = "rmpa.service"
# How one is started that does not start with the machine; and one that has no name and keys.
START: Final = "sudo systemctl enable --now rmpa"
INSTALL: Final = "sudo rmpa service install"
# What systemd sets for the process that it starts, and that means no child of it.
SERVICE_VARIABLES: Final = ("NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC")
# Seconds after which a sign of life that could not be sent is tried again.
_WATCHDOG_RETRY: Final = 1.0
_CANNOT_TELL: Final = "! the service manager at NOTIFY_SOCKET=%s cannot be told %s: %s [watchdog]"
# The line of proc(5)'s cgroup of a process that a unit of the system runs.
_OF_UNIT: Final = re.compile(r":/system\.slice/(rmpa[\w-]*)\.service", re.MULTILINE)


class LogWriter:
    """The text stream of a log handler.

    A pipe that is not read (a stopped pager, a hanging journal) blocks its writer. The queue of lines is bounded:
    when it is full, new lines are lost, and their number is logged once the pipe is read again.

    Args:
        fd: The file descriptor for the lines; not closed here.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._waiting: deque[str] = deque()
        self._wake = threading.Event()
        self._closed = False
        # The number of lost lines that is not logged yet.
        self.lost = 0
        self._thread = threading.Thread(target=self._work, name="log", daemon=True)
        self._thread.start()

    def write(self, text: str) -> int:
        """Queue one or more lines; never blocks."""
        if len(self._waiting) >= limits.LOG_WAITING:
            self.lost += 1
        else:
            self._waiting.append(text)
            self._wake.set()
        return len(text)

    def flush(self) -> None:
        """Do nothing: the thread writes as soon as it can."""

    def close(self) -> None:
        """Wait until all lines are written, but no longer than ``limits.DRAIN_TIMEOUT``."""
        self._closed = True
        self._wake.set()
        self._thread.join(limits.DRAIN_TIMEOUT)

    def _work(self) -> None:
        while not self._closed or self._waiting:
            self._wake.wait()
            if not self._closed:
                time.sleep(limits.LOG_GATHER)  # so that the lines of a burst are written in one call
            self._wake.clear()
            while self._waiting:
                self._write()
            if self.lost:
                lost, self.lost = self.lost, 0
                _log.warning(
                    "! %d log lines were lost: the program that reads the log had stopped [log-lines-lost]", lost
                )

    def _write(self) -> None:
        lines = [self._waiting.popleft() for _ in range(min(len(self._waiting), limits.LOG_BATCH))]
        rest = memoryview("".join(lines).encode(errors="backslashreplace"))
        while rest:
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                time.sleep(limits.LOG_GATHER)  # the pipe is full, and another process has made it non-blocking
            except OSError:
                return  # the pipe is closed


def in_journal(environ: Mapping[str, str], fd: int) -> bool:
    """Whether a descriptor leads to systemd's journal, by JOURNAL_STREAM (systemd.exec(5))."""
    try:
        status = os.fstat(fd)
    except OSError:
        return False
    return environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def unit_of(pid: int | str = "self") -> str:
    """The system's unit that an agent runs in, ``rmpa``; empty: it was started by hand."""
    try:
        found = _OF_UNIT.search(Path(f"/proc/{pid}/cgroup").read_text("utf-8", "replace"))
    except OSError:
        return ""
    return found[1] if found else ""


def is_set_up(unit: Mapping[str, str]) -> bool:
    """Whether a unit has the user's name and keys: it runs, or ``rmpa service install`` or the user made its file.

    The Debian package's may never have had them. ``rmpa service install`` changes nothing where it has.
    """
    return unit.get("ActiveState") != "inactive" or unit.get("FragmentPath", "").startswith("/etc/")


def restart_text(pid: int | str = "self", start: str = "rmpa up") -> str:
    """How an agent is restarted, behind "restart …: "; ``start`` starts one that no unit runs."""
    unit = unit_of(pid)
    return f"sudo systemctl restart {unit}" if unit else f"end it (Ctrl-C), then {start}"


def notify_service_manager(state: str) -> bool:
    """Send ``READY=1``, ``STOPPING=1`` or ``STATUS=…``; a failure is logged and never fatal.

    Returns:
        Whether it was sent.
    """
    address = _notify_address()
    if not address:
        return False
    try:
        with _notify_socket() as sock:
            sock.sendto(state.encode(), address)
    except OSError as error:
        _log.warning(_CANNOT_TELL, address, state, error)
        return False
    return True


def _notify_address() -> str:
    address = os.environ.get("NOTIFY_SOCKET", "")
    return "\0" + address[1:] if address.startswith("@") else address


def _notify_socket() -> socket.socket:
    return socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)


def watchdog_period(environ: Mapping[str, str]) -> float | None:
    """Half of the time in seconds in which systemd wants ``WATCHDOG=1``; ``None``: never (sd_watchdog_enabled(3))."""
    usec, pid = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID", "")
    if not usec.isdecimal() or int(usec) == 0 or pid not in ("", str(os.getpid())):
        return None
    return int(usec) / 2e6


def feed_watchdog(loop: AbstractEventLoop) -> None:
    """Send ``WATCHDOG=1`` from the event loop for as long as it runs, if systemd wants it.

    A loop that hangs sends none, and systemd ends the process by SIGABRT; where it hung is then in the log.
    """
    period, address = watchdog_period(os.environ), _notify_address()
    if period is None or not address:
        return
    faulthandler.enable()
    sock: socket.socket | None = None
    failed = False

    def feed() -> None:
        nonlocal sock, failed
        try:
            # One socket for all: later there may be no descriptor left.
            sock = sock or _notify_socket()
            # A service manager that does not read must not stop the loop.
            sock.sendto(b"WATCHDOG=1", socket.MSG_DONTWAIT, address)
        except OSError as error:
            if not failed:
                _log.warning(_CANNOT_TELL, address, "WATCHDOG=1", error)
            failed = True
        else:
            failed = False
        loop.call_later(min(period, _WATCHDOG_RETRY) if failed else period, feed)

    feed()
