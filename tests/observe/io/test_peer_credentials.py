"""Who may use the control socket: the kernel says which user a client is."""

from __future__ import annotations

import asyncio
import grp
import os
import socket
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import StartError
from rmpa.observe.control_client import ControlReply
from rmpa.observe.control_server import ControlServer, control_group, peer_credentials

if TYPE_CHECKING:
    from pathlib import Path

NOBODY = 65534
GROUP = 54321
ASK = """
import os, socket, sys
path, uid, groups = sys.argv[1], int(sys.argv[2]), [int(each) for each in sys.argv[3].split(",") if each]
os.setgroups(groups), os.setgid(uid), os.setuid(uid)
client = socket.socket(socket.AF_UNIX)
try:
    client.connect(path)
    client.sendall(b'{"op":"echo"}\\n')
    sys.stdout.write(client.makefile().readline())
except OSError as error:
    sys.stdout.write(error.strerror)
"""
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root may become another user")


async def ask(path: Path, uid: int, groups: str = "") -> str:
    """What a program of another user gets from a control socket."""
    command = [sys.executable, "-c", ASK, str(path), str(uid), groups]
    done = await asyncio.to_thread(subprocess.run, command, capture_output=True, text=True, check=True)
    return done.stdout


def open_to_all(place: Path) -> None:
    """Take the modes away that keep other users from the socket, as a bind mount or a careless chmod does."""
    for each in (place / "base.sock", place, *place.parents):
        if str(each) not in ("/", "/tmp"):
            each.chmod(each.stat().st_mode | 0o007)


def test_the_kernel_tells_user_process_and_groups() -> None:
    one, other = socket.socketpair(socket.AF_UNIX)
    with one, other:
        groups = frozenset({os.getegid(), *os.getgroups()})
        assert peer_credentials(one) == (os.getpid(), os.geteuid(), groups)


def test_the_agents_user_root_and_the_group_are_served(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    server = ControlServer(place, "base", {}, group=7)
    assert server.serves(1000, frozenset())
    assert server.serves(0, frozenset())
    assert server.serves(1001, frozenset({5, 7}))
    assert not server.serves(1001, frozenset({5}))
    assert not ControlServer(place, "base", {}).serves(1001, frozenset({7, 1000}))


def test_the_group_is_known_by_name_or_number() -> None:
    assert control_group(grp.getgrgid(0).gr_name) == control_group("0") == 0
    assert control_group("") is None
    with pytest.raises(StartError, match=r"no group 'robotz'; make it \(sudo groupadd robotz\), or change group"):
        control_group("robotz")


@as_root
async def test_another_user_is_refused_though_it_reaches_the_socket(place: Path) -> None:
    server = ControlServer(place, "base", {"echo": lambda args: args})
    await server.start()
    try:
        assert "Permission denied" in await ask(server.path, NOBODY)
        assert server.counters["control.user"] == 0
        open_to_all(place)
        reply = ControlReply.parse((await ask(server.path, NOBODY)).encode())
        assert not reply.ok
        assert reply.error == f"user {NOBODY} may not use the control socket of user 0"
        assert reply.remedy == "use sudo, or name a group of yours as group of [control] in rmpa.toml"
        assert server.counters["control.user"] == 1
        assert '"ok":true' in await ask(server.path, 0)
    finally:
        await server.close()


@as_root
async def test_users_of_the_group_get_in(place: Path) -> None:
    for above in place.parents:
        if str(above) not in ("/", "/tmp"):
            above.chmod(above.stat().st_mode | 0o011)
    server = ControlServer(place, "base", {"echo": lambda args: args}, group=GROUP)
    await server.start()
    try:
        assert place.stat().st_mode & 0o777 == 0o750
        assert server.path.stat().st_mode & 0o777 == 0o660
        assert '"ok":true' in await ask(server.path, NOBODY, f"{GROUP},{NOBODY}")
        assert "Permission denied" in await ask(server.path, NOBODY)
    finally:
        await server.close()


async def test_without_a_group_the_directory_is_closed_again(place: Path) -> None:
    place.chmod(0o750)
    server = ControlServer(place, "base", {})
    await server.start()
    await server.close()
    assert place.stat().st_mode & 0o777 == 0o700
