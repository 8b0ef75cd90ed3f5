"""What the bridge does with control messages; whole bridges are tested with their agents."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from rmpa.bridge import limits
from rmpa.bridge.bridge import Bridge
from rmpa.bridge.messages import Advertise, AdvertiseServices, TopicOffer, encode
from rmpa.bridge.sessions import Part
from rmpa.config import limits as config_limits
from rmpa.config.settings import Settings
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.mesh.io.link import PeerLink
from rmpa.ros.core.embedded import RosCore

LINK = cast("PeerLink", object())


class Core:
    """What making a bridge needs of a core."""

    uri = "http://127.0.0.1:1/"
    node_host = node_address = "127.0.0.1"


@pytest.fixture
async def bridge(monkeypatch: pytest.MonkeyPatch) -> Bridge:
    made = Bridge(cast("RosCore", Core()), Settings(), rng=lambda: 0.5)
    session = SimpleNamespace(peer=1)
    monkeypatch.setattr(made.sessions, "of", lambda link: session if link is LINK else None)
    return made


def test_the_longest_advertisement_of_ours_is_within_the_limit_of_one() -> None:
    longest = "/" + "x" * (config_limits.CROSSING_NAME_MAX - 1)
    kind = f"a/{'x' * (config_limits.CROSSING_NAME_MAX - 2)}"
    offers = tuple(TopicOffer(longest, longest, kind) for _ in range(limits.ADVERTISED_AT_ONCE))
    assert len(encode(Advertise(added=offers, full=True, more=True))) < limits.ADVERTISEMENT_MAX


async def test_a_longer_one_ends_the_link_unparsed(bridge: Bridge) -> None:
    payload = encode(Advertise()).replace(b"[]", b" " * limits.ADVERTISEMENT_MAX + b"[]", 1)
    with pytest.raises(LimitExceeded):
        bridge.control(LINK, payload)
    bridge.control(cast("PeerLink", object()), payload)  # of a link that is gone


@pytest.mark.parametrize(
    "payload",
    [
        encode(AdvertiseServices()), b' {"op":"services"}', b'{ "op" : "services",\n "added" : [] }',
        b'{"added":[],"op":"services"}',
    ],
)  # fmt: skip
async def test_advertisements_go_to_their_part(bridge: Bridge, payload: bytes) -> None:
    taken: list[bytes] = []

    class Services(Part):
        advertisement = "services"

        def advertised(self, session: Any, payload: bytes) -> None:
            assert session.peer == 1
            taken.append(payload)

    bridge.add(Services())
    bridge.control(LINK, memoryview(payload))
    assert taken == [payload]


async def test_a_message_that_no_part_takes_ends_the_link(bridge: Bridge) -> None:
    reordered = b'{"added":[],"op":"services"}'  # no part for services was added
    with pytest.raises(RemoteProtocolError, match="AdvertiseServices"):
        bridge.control(LINK, reordered)
