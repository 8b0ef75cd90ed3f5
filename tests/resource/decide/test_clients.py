from __future__ import annotations

import pytest

from rmpa.core.errors import ConfigError
from rmpa.resource import limits
from rmpa.resource.decide.reports import Clients
from rmpa.resource.declare.attributes import LATENCY, RATE

NOW_NS = 1_800_000_000_000_000_000
ASKS = [("rate", ">= 20 Hz"), ("expires", "30 s")]


def clients() -> Clients:
    return Clients("camera", {"rate": RATE, "latency": LATENCY})


def test_refusal_lasts_until_a_valid_request() -> None:
    one = clients()
    one.received("/a", "m" * 9999, "")
    assert len(one.mark("/a")) == limits.REQUIREMENT_TEXT_MAX
    with pytest.raises(ConfigError):
        one.read("/a", [("rat", ">= 20 Hz")], 1.0)
    one.refuse("/a", "no such attribute")
    assert (one.refusal("/a"), one.refused) == ("no such attribute", ["/a"])
    requirement = one.read("/a", ASKS, 1.0)
    assert requirement is not None
    assert (requirement.client, requirement.expires) == ("/a", 31.0)
    assert (one.refusal("/a"), one.refused) == ("", [])
    assert (one.refusal("/b"), one.mark("/b")) == ("", "")


def test_repeated_latched_request_keeps_its_expiry(monkeypatch: pytest.MonkeyPatch) -> None:
    one = clients()
    for now, expires in ((1.0, 31.0), (20.0, 31.0), (31.0, None)):
        one.received("/a", "m", "5.000000000")
        found = one.read("/a", ASKS, now)
        assert (found and found.expires) == expires
    one.received("/a", "m", "6.000000000")
    again = one.read("/a", ASKS, 40.0)
    assert again is not None
    assert again.expires == 70.0
    one.received("/a", "m", "")  # without a stamp each one is new
    unstamped = one.read("/a", ASKS, 50.0)
    assert unstamped is not None
    assert unstamped.expires == 80.0
    monkeypatch.setattr(limits, "RESOURCE_STAMPS_MAX", 2)
    for number in range(5):
        one.received("/a", "m", f"{number}.5")
        one.read("/a", ASKS, 60.0)
    assert list(one.expiries) == [("/a", "3.5"), ("/a", "4.5")]


def test_absent_client_is_removed() -> None:
    one = clients()
    one.received("/a", "m", "")
    one.received("/b", "n", "")
    assert one.remove_absent({"/a"}, 1.0) == []
    assert one.remove_absent({"/a", "/b"}, 2.0) == []  # it was only connecting anew
    assert one.remove_absent({"/a"}, 3.0) == []
    assert one.remove_absent({"/a"}, 4.0) == ["/b"]
    assert one.mark("/b") == ""
    assert one.remove_absent(set(), 5.0) == []
    assert one.remove_absent(set(), 6.0) == ["/a"]  # also one that asked for nothing any more


def test_requirements_wait_for_their_clients_after_a_restart() -> None:
    before = clients()
    before.received("/a", "m", "5.0")
    before.received("/b", "n", "")
    requirements = {}
    for name, values in (("/a", ASKS), ("/b", [("latency", "<= 1 s")])):
        requirement = before.read(name, values, 10.0)
        assert requirement is not None
        requirements[name] = requirement
    asked = before.save(requirements | {"context lab": requirements["/a"]}, 12.0, NOW_NS)
    assert [(a.client, a.mark, a.stamp, a.expires_ns) for a in asked] == [
        ("/a", "m", "5.0", NOW_NS + 28 * 10**9),
        ("/b", "n", "", None),
    ]
    after = clients()
    found = after.restore(asked, 100.0, NOW_NS + 8 * 10**9)
    assert [(r.client, r.expires) for r in found] == [("/a", 120.0), ("/b", None)]
    grace = 100.0 + limits.RESOURCE_CLIENT_GRACE
    after.received("/b", "n", "")  # it is back
    for now in (101.0, 102.0):
        assert after.remove_absent({"/b"}, now) == []
    after.received("/a", "m", "5.0")
    again = after.read("/a", ASKS, 110.0)
    assert again is not None
    assert again.expires == 120.0
    silent = clients()
    silent.restore(asked, 100.0, NOW_NS)
    assert silent.remove_absent(set(), grace - 1) == []
    assert silent.remove_absent(set(), grace) == []
    assert silent.remove_absent(set(), grace + 1) == ["/a", "/b"]
