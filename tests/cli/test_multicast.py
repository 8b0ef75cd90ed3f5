"""``rmpa multicast``, on loopback."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.cli.conftest import Place

PORT = str(20000 + os.getpid() % 20000)


def test_what_one_sends_the_other_receives(place: Place) -> None:
    with place.start("multicast", "receive", "--interface", "lo", "--port", PORT, "-t", "20") as receiver:
        assert receiver.stdout is not None
        waiting = receiver.stdout.readline()
        assert waiting == f"waiting on lo (127.0.0.1) for packets to 239.255.82.77:{PORT}\n"
        code, out, err = place.run("multicast", "send", "--interface", "lo", "--port", PORT)
        assert (code, out, err) == (0, f"sent on lo (127.0.0.1) to 239.255.82.77:{PORT}\n", "")
        out, _ = receiver.communicate(timeout=30)
        assert receiver.returncode == 0
        assert out.startswith("from 127.0.0.1:")
        assert "on lo: 'rmpa multicast 1 of 1'" in out


def test_several_as_json(place: Place) -> None:
    words = ("--interface", "lo", "--port", PORT, "--json", "-c", "3")
    with place.start("multicast", "receive", *words, "-t", "20") as receiver:
        # It joins before it can be known to: send until it has enough.
        for _ in range(20):
            sent = place.json("multicast", "send", *words, "-i", "0.01")
            assert [line["sent"] for line in sent] == [True] * 3
            if receiver.poll() is not None:
                break
        out, _ = receiver.communicate(timeout=30)
    assert receiver.returncode == 0
    lines = [json.loads(line) for line in out.splitlines()]
    assert len(lines) == 3
    assert {line["interface"] for line in lines} == {"lo"}


def test_nothing_comes(place: Place) -> None:
    code, _, err = place.run("multicast", "receive", "--interface", "lo", "--port", PORT, "-t", "0.1")
    assert code == 1
    assert "0 of 1 packets came" in err


def test_what_cannot_be(place: Place) -> None:
    code, _, err = place.run("multicast", "send", "--interface", "nosuch0")
    assert code == 2
    assert err.startswith("rmpa: --interface: nosuch0 is not here; there are ")
    code, _, err = place.run("multicast", "send", "--interface", "lo", "--group", "10.0.0.1")
    assert code == 2
    assert "not an IPv4 multicast group" in err
    assert place.run("multicast", "receive", "--port", "0")[0] == 2
