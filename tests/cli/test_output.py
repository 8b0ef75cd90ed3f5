"""Figures and messages as text."""

from __future__ import annotations

import logging

import click
import msgspec
import pytest

from rmpa.cli.graph import read_name
from rmpa.cli.main import PlacedHelp, help_of
from rmpa.cli.output import (
    Painted,
    duration,
    fill_stamps,
    flatten,
    pick,
    print_error,
    print_text,
    printable,
    read_values,
    shorten,
    size,
    to_text,
    warn,
)
from rmpa.cli.topic import facts
from rmpa.core import errors
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError
from rmpa.core.facts import RouteInfo
from rmpa.core.log import _Formatter
from rmpa.ros.types.messages import Plain
from tests.observe.samples import DIRECT


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (None, "-"),
        (float("nan"), "-"),
        (0.0, "0 µs"),
        (0.000432, "432 µs"),
        (0.0123, "12.30 ms"),
        (-0.00125, "-1.25 ms"),
        (0.5, "500 ms"),
        (4.2, "4.2 s"),
        (59.9, "59.9 s"),
        (59.96, "1 min 0 s"),
        (200, "3 min 20 s"),
        (3599.9, "1 h 0 min"),
        (7500, "2 h 5 min"),
        (86400 * 3 + 3600 * 4, "3 d 4 h"),
        (-90, "-1 min 30 s"),
        (-3661, "-1 h 1 min"),
    ],
)
def test_durations(seconds: float | None, text: str) -> None:
    assert duration(seconds) == text


@pytest.mark.parametrize(
    ("count", "text"),
    [(None, "-"), (0, "0 B"), (999, "999 B"), (1234, "1.23 kB"), (12_345_678, "12.3 MB"), (5e15, "5000 TB")],
)
def test_sizes(count: float | None, text: str) -> None:
    assert size(count) == text


def test_nothing_from_outside_moves_the_cursor() -> None:
    assert printable("a\x1b[2J\nb") == "a\\x1b[2J\\nb"
    assert to_text({"data": "\x1b[31m"}) == 'data: "\\x1b[31m"'


def test_an_error_in_the_words_of_a_peer_turns_and_hides_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    print_error(PeerRefused("arm", "\x1b[2Jfine\u202e\nand so on"), "refused")
    error = capsys.readouterr().err
    assert "\\x1b[2Jfine\\u202e [refused]\nand so on" in error
    assert all(character.isprintable() for character in error.replace("\n", ""))


def test_messages_as_text() -> None:
    message: Plain = {"h": {"t": {"secs": 1, "nsecs": 2}}, "s": 'a"b', "l": [1, 2], "m": [{"x": 1.5}], "e": []}
    assert to_text(message) == (
        'h:\n  t:\n    secs: 1\n    nsecs: 2\ns: "a\\"b"\nl: [1, 2]\nm:\n  -\n    x: 1.5\ne: []'
    )
    short = (
        "h:\n  t:\n    secs: 1\n    nsecs: 2\ns: <string length: 3>\nl: <array length: 2>\nm: <array length: 1>\ne: "
    )
    assert to_text(shorten(message, arrays=True, strings=True)).startswith(short)
    assert list(flatten(message)) == [
        ("field.h.t", "1000000002"),
        ("field.s", 'a"b'),
        ("field.l0", "1"),
        ("field.l1", "2"),
        ("field.m0.x", "1.5"),
    ]


def test_picking_a_field() -> None:
    message: Plain = {"a": [{"b": [1, 2]}]}
    assert pick(message, ["a[0]", "b[1]"]) == 2
    for path in (["c"], ["a[1]"], ["a", "b"], ["a[x]"]):
        with pytest.raises(RmpaError):
            pick(message, path)


def test_values_of_the_command_line() -> None:
    assert read_values(()) is None
    assert read_values(("hello",)) == "hello"
    assert read_values(("{x: 1}",)) == {"x": 1}
    assert read_values(("1", "[2, 3]")) == [1, [2, 3]]
    with pytest.raises(ConfigError, match="not YAML"):
        read_values(("{",))


def test_stamps_are_filled() -> None:
    filled = fill_stamps({"header": "auto", "poses": [{"stamp": "now", "text": "now"}]}, 1_000_000_002)
    stamp = {"secs": 1, "nsecs": 2}
    assert filled == {"header": {"stamp": stamp}, "poses": [{"stamp": stamp, "text": "now"}]}


def test_topics_with_and_without_a_peer() -> None:
    assert str(read_name("joystick:cmd/")) == "joystick:/cmd"
    for text in ("", ":", ":/x", "a b", "~x", "base:"):
        with pytest.raises(ConfigError):
            read_name(text)


def test_a_contract_is_shown_with_the_units_of_its_keys() -> None:
    contract: dict[str, str | float | None] = {
        "reliability": "reliable", "depth": 90, "deadline": 0.2, "lifespan": 90.0, "max_rate": 12.5
    }  # fmt: skip
    route = RouteInfo(peer="joystick", node="/joy", direction="out", state="open", contract=contract)
    # As it comes from the agent: a whole number is a float behind JSON.
    crossed = msgspec.json.decode(msgspec.json.encode(route), type=RouteInfo)
    for one in (route, crossed):
        shown = dict(facts(one))["contract"]
        assert shown == "reliability reliable, depth 90, deadline 200 ms, lifespan 1 min 30 s, max_rate 12.5 Hz"


def test_an_unknown_loss_is_not_shown_as_none() -> None:
    route = RouteInfo(peer="a", node="/t", direction="in", state="open", messages=9, events={"loss_unknown": 5})
    assert dict(facts(route))["missing"] == "loss unknown (5 times), 0 late, 0 expired, 0 dropped here"
    known = msgspec.structs.replace(route, lost=3, events={"loss_unknown": 1})
    assert dict(facts(known))["missing"].startswith("loss unknown (once), 3 more lost, ")


def test_a_direct_topic_tells_that_it_was_interrupted() -> None:
    texts = [text for _, text in facts(DIRECT)]
    told = "interrupted 2 times, the last for 39.0 s, until 12.0 s ago; what is lost of that time is not counted"
    assert told in texts
    one = msgspec.structs.replace(DIRECT.subscribers[0], interruptions=1, interrupted_ago=None)
    texts = [text for _, text in facts(msgspec.structs.replace(DIRECT, subscribers=(one,)))]
    assert "interrupted once, the last for 39.0 s now; what is lost of that time is not counted" in texts


def test_all_that_a_terminal_or_a_log_shows_says_where_pages_are(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(errors, "_place_of_docs", lambda: ("/usr/share/doc/rmpa/", ""))
    page = "docs/guides/web.md"
    print_text(page, Painted(page))
    warn(page)
    print_error(page, "failed")
    logged = _Formatter().format(logging.LogRecord("rmpa", 30, "", 0, "see %s", (page,), None))
    help_ = PlacedHelp("x", **help_of(f"Do.\n\n---\nSee {page}.")).get_help(click.Context(click.Command("x")))
    out, err = capsys.readouterr()
    for text in (*out.splitlines(), *err.splitlines(), logged, help_):
        assert f"/usr/share/doc/rmpa/{page}" in text
