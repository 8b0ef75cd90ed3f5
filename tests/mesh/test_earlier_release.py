"""Links with the release before pace and lane frames, which has none of these features.

The bytes were recorded from that release, and must not be made by the present code.
"""

from __future__ import annotations

import pytest

from rmpa.mesh import limits
from rmpa.mesh.connection import ConnectionRole, ConnectionState
from rmpa.mesh.connection_events import ConnectionClosed
from rmpa.mesh.handshake import Feature
from tests.mesh.worlds import HIGH, LOW, Side, Time, deliver, side

HELLO = bytes.fromhex(
    "000000340103000000000000000000000000000000000000"
    "524d5041010100000a0000019c4100014c4c4c4c4c4c4c4c4c4c4c4c4c4c4c4c000003e80a0000029c42000100000000036c6f77"
)
"""low dials high."""
WELCOME = bytes.fromhex(
    "000000350203000000000000000000000000000000000000"
    "524d5041010100000a0000029c42000148484848484848484848484848484848000003e80a0000019c410001000000000468696768"
)
"""high accepts low."""
PING = bytes.fromhex("0000000004030000000000000000000017979d157ea0e800")
BYE = bytes.fromhex("0000000808030000000000000000000017979d15ab54ff806c6f7720656e6473")
KINDS = frozenset(range(1, 12))
"""The frames that the release knows. It ends a connection on which another one arrives."""
FEATURES = slice(24 + 44, 24 + 48)
"""The field of a hello and a welcome that the release sets to 0, and does not look at."""


def as_it_reads(frame: bytes, like: bytes) -> bytes:
    """A hello or welcome without what the release does not read: features, and bytes behind the name."""
    cut = frame[: len(like)]
    return like[:4] + cut[4 : FEATURES.start] + bytes(4) + cut[FEATURES.stop :]


def frames(data: bytes) -> list[tuple[int, bytes]]:
    """The kind and the bytes of each frame."""
    found = []
    while data:
        size = 24 + int.from_bytes(data[:4])
        found.append((data[4], data[:size]))
        data = data[size:]
    return found


def linked(role: ConnectionRole, time: Time) -> tuple[Side, list[int]]:
    """A side of the present release that is linked with one of the earlier release, and the kinds that it sent."""
    if role is ConnectionRole.DIALLER:
        made = side(role, LOW, time, expected=HIGH.guid)
        sent = made.link.take_output()
        assert as_it_reads(sent, HELLO) == HELLO
        deliver(WELCOME, made.link, time.now)
    else:
        made = side(role, HIGH, time)
        deliver(HELLO, made.link, time.now)
        made.link.accept(time.now)
        sent = made.link.take_output()
        assert as_it_reads(sent, WELCOME) == WELCOME
    assert made.link.state is ConnectionState.UP
    assert made.link.remote is not None
    assert not any(made.link.remote.features & feature for feature in Feature)
    return made, [kind for kind, _ in frames(sent + made.link.take_output())]


def let_pass(made: Side, time: Time, seconds: float) -> list[int]:
    """Let the earlier release send its keepalives for a while; return the kinds of the frames that it got."""
    end, got = time.now + seconds, []
    while time.now < end:
        time.now += limits.KEEPALIVE_INTERVAL
        while (due := made.link.next_timer()) is not None and due <= time.now:
            made.link.handle_timer(due)
        deliver(PING, made.link, time.now)
        got += [kind for kind, _ in frames(made.link.take_output())]
    return got


@pytest.mark.parametrize("role", ConnectionRole)
def test_the_earlier_release_gets_only_frames_that_it_knows(role: ConnectionRole) -> None:
    time = Time()
    made, sent = linked(role, time)
    for needed in (True, False, True, False):
        made.link.need(time.now, needed=needed)
        sent += let_pass(made, time, 5 * limits.REST_AFTER)
        assert not made.link.rests
    assert made.link.state is ConnectionState.UP, "a link that nothing needs is not lost"
    assert set(sent) <= KINDS
    deliver(BYE, made.link, time.now)
    assert isinstance(made.last(), ConnectionClosed)


@pytest.mark.parametrize("role", ConnectionRole)
def test_the_silence_of_the_earlier_release_is_noticed_within_a_second(role: ConnectionRole) -> None:
    time = Time()
    made, _ = linked(role, time)
    made.link.need(time.now, needed=False)
    let_pass(made, time, 60.0)
    heard = time.now
    while (due := made.link.next_timer()) is not None and made.link.state is ConnectionState.UP:
        time.now = max(time.now, due)
        made.link.handle_timer(time.now)
    assert made.link.state is ConnectionState.CLOSED
    assert limits.EXPRESS_LEASE <= time.now - heard < limits.EXPRESS_LEASE + 0.01
