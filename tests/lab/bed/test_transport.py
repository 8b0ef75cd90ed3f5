"""The kernel tells by which transport two processes are connected, and a bench that measured another one fails."""

from __future__ import annotations

import os
import socket
import sys
import tomllib
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast, get_args

import pytest

from lab.bed.plan import Transport
from lab.bed.processes import BedError, Process
from lab.bed.transport import is_direct, require, settings

if TYPE_CHECKING:
    from collections.abc import Iterator

PUBLISHER = """
import socket
server = socket.create_server(("127.0.0.1", 0))
print('@ {"event": "up", "port": %d}' % server.getsockname()[1], flush=True)
accepted = [server.accept() for _ in range(2)]
"""
RELAY = """
import socket, sys
kept = socket.create_connection(("127.0.0.1", int(sys.argv[1])))
print('@ {"event": "up"}', flush=True)
sys.stdin.read()
"""


@pytest.fixture
def publisher() -> Iterator[Process]:
    with Process([sys.executable, "-c", PUBLISHER], name="talker") as process:
        process.wait_event("up")
        yield process


@pytest.fixture
def subscriber() -> Process:
    return cast("Process", SimpleNamespace(pid=os.getpid(), name="listener"))


def connect(publisher: Process) -> socket.socket:
    return socket.create_connection(("127.0.0.1", int(str(publisher.events("up")[0]["port"]))))


def test_a_connection_that_the_publisher_accepted_is_direct(publisher: Process, subscriber: Process) -> None:
    assert not is_direct(publisher.pid, subscriber.pid)
    with connect(publisher):
        require("direct", [(publisher, subscriber)])
        assert not is_direct(subscriber.pid, publisher.pid)
        with pytest.raises(BedError, match="listener is connected to talker: what should be relayed is direct"):
            require("relay", [(publisher, subscriber)])


def test_a_connection_through_another_process_is_relayed(publisher: Process, subscriber: Process) -> None:
    port = str(publisher.events("up")[0]["port"])
    with Process([sys.executable, "-c", RELAY, port], commands=True) as relay:
        relay.wait_event("up")
        require("direct", [(publisher, relay)])
        require("relay", [(publisher, subscriber)])
        with pytest.raises(BedError, match="listener is not connected to talker"):
            require("direct", [(publisher, subscriber)], timeout=0.2)


def test_a_process_that_has_ended_is_connected_to_nothing(publisher: Process, subscriber: Process) -> None:
    with connect(publisher):
        require("direct", [(publisher, subscriber)])
        publisher.kill()
        assert not is_direct(publisher.pid, subscriber.pid)


@pytest.mark.parametrize("transport", get_args(Transport))
def test_topics_and_services_are_given_the_same_transport(transport: Transport) -> None:
    found = tomllib.loads(settings(transport))
    assert found["bridge"]["transport"] == found["services"]["transport"] == transport
