"""``rmpa param`` against our own core, and against a fake agent's peer."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.bridge import limits
from rmpa.bridge.params import owner as requests
from rmpa.cli.param import read_documents, read_yaml, write_yaml
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.wire.xmlrpc import parse_response, serialize_response
from tests.cli.conftest import Place, compare, settled


def test_the_verbs(place: Place, core: RosCore) -> None:
    place.environ["ROS_MASTER_URI"] = core.uri
    (place.path / "ns.yaml").write_text("_ns: inner\na: 1\n---\nb: 2\n")
    said = place.transcript(
        "set /base '{speed: 1.5, names: [a, \"on\"], deep: {x: -3}}'", "get /base/deep/x", "get /base",
        "get base --json", "set /base/deep -5", "list /base", "get /base/sped",
        "dump base.yaml /base", "load base.yaml /copy", "get /copy", "delete /copy", "delete /copy",
        "load ns.yaml /outer --json", "get /outer",
        group="param",
    )  # fmt: skip
    compare("param", settled(said, place.path))


def test_mistakes_change_nothing(place: Place, core: RosCore) -> None:
    place.environ["ROS_MASTER_URI"] = core.uri
    (place.path / "list.yaml").write_text("- 1\n")
    said = place.transcript(
        "set /a [1,", "set /a null", "set /a '{1: 2}'", "set /a 99999999999", "set /a '{b: 1, b: 2}'", "set /a",
        "set /a 1 -t x", "set / 5", "set /a '{b: {\"c d\": 1}}'", "set /a -t nothing",
        "get ~a", "get /a//b", "delete /", "load list.yaml", "get /a --peer b --master http://x:1/",
        group="param",
    )  # fmt: skip
    compare("param_mistakes", settled(said, place.path))
    assert core.call("hasParam", "/x", "/a").value is False


@pytest.fixture
def peer(agent: Callable[..., None]) -> dict[str, Any]:
    """A fake agent whose only peer, base, has these parameters."""
    kept: dict[str, Any] = {"/speed": 1.5, "/big": "x" * (3 * limits.ASK_EXPRESS_MAX)}

    def ask(args: dict[str, object]) -> object:
        assert args["peer"] == "base"
        key = str(args.get("key"))
        match args["what"]:
            case requests.GET if key not in kept:
                raise PeerRefused("base", f"there is no parameter {key}")
            case requests.GET:
                return {"text": serialize_response(kept[key]).decode()}
            case requests.NAMES:
                return {"text": serialize_response(list(kept)).decode()}
            case requests.SET:
                kept[key] = parse_response(requests.text_of(args).encode())
                return {"count": 1}
        del kept[key]
        return {}

    agent("pad", param=ask)
    return kept


def test_a_peers(place: Place, peer: dict[str, Any]) -> None:
    assert place.json("param", "get", "base:/big", "--json") == [peer["/big"]]
    (place.path / "text").write_text("é" * 40_000)
    assert place.json("param", "set", "--peer", "base", "/new", "-t", "text", "--json") == [{"key": "/new", "set": 1}]
    assert peer["/new"] == "é" * 40_000
    said = place.transcript(
        "get --peer base /speed", "list --peer base", "list base:/", "get --peer arm base:/big",
        "delete --peer base /new", "get --peer base /nothing", "get hall/arm:/speed",
        group="param",
    )  # fmt: skip
    compare("param_of_a_peer", said)
    assert "/new" not in peer


_SCALARS = (
    st.booleans()
    | st.integers(-(1 << 31), (1 << 31) - 1)
    | st.floats(allow_nan=False)
    | st.text(max_size=200)
    | st.binary(max_size=40)
)
_VALUES = st.recursive(
    _SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text("abn-1:#' ", min_size=1), inner, max_size=4),
    max_leaves=12,
)


@given(_VALUES)
def test_what_is_written_is_read_again(value: Any) -> None:
    back = read_yaml(write_yaml(value), "x")
    assert back == value
    assert type(back) is type(value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("on", True), ("'on'", "on"), ("y", "y"), ("010", 8), ("0o7", "0o7"), ("1:30", 90), ("1e3", "1e3"),
        ("1.0e+3", 1000.0), ("0x1f", 31), ("1_000", 1000), (".5", 0.5), ("!!str", ""), ("", ""), ("=", "="),
        ("!!binary aGk=", b"hi"), ("deg(90)", math.pi / 2), ("rad(pi/2)", math.pi / 2), ("!degrees 180", math.pi),
        ("!radians 2*pi", 2 * math.pi), ("rad(-(pi)/2)", "rad(-(pi)/2)"), ("<<: {a: 1}", {"a": 1}), ("-5", -5),
    ],
)  # fmt: skip
def test_yaml_as_rosparam_reads_it(text: str, value: object) -> None:
    found = read_yaml(text, "x")
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    "text", ["rad(__import__)", "!radians x", "!degrees 1/0", "!radians 9**9**9", "&a [*a]", "!x 1"]
)
def test_what_is_no_angle_and_no_yaml(text: str) -> None:
    with pytest.raises(RmpaError):
        read_yaml(text, "x")


LONG = "it's a text, longer than a line of YAML may be, so that it is broken where a space stands in it"
MARKUP = '<a b="c">\n  <d e=\'f\'/>  <!-- it\'s "here" & <there> \u00e9 and so on, up to the next line -->\n</a>\n'


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ({"k": LONG}, f"k: {LONG[:82]}\n  {LONG[83:]}\n"),
        (
            {"k": MARKUP},
            (
                'k: "<a b=\\"c\\">\\n  <d e=\'f\'/>  <!-- it\'s \\"here\\" & <there> \\xE9 and so on, up to\\\n'
                '  \\ the next line -->\\n</a>\\n"\n'
            ),
        ),
        ("two\n lines\n", '"two\\n lines\\n"\n'),
        ("one\ntwo", "'one\n\n  two'\n"),
        (1e17, "1.0e+17\n...\n"),
        ({"b": [[1, []], {"b": {}}], "a": "on"}, "a: 'on'\nb:\n- - 1\n  - []\n- b: {}\n"),
    ],
    ids=repr,
)
def test_yaml_as_pyyaml_writes_it(value: Any, text: str) -> None:
    assert write_yaml(value) == text


def test_documents() -> None:
    assert read_documents("a: 1\n---\nb: 2001-01-01\n", "x") == [
        {"a": 1},
        {"b": read_yaml("2001-01-01 00:00:00", "x")},
    ]
    assert json.loads(json.dumps(read_documents("", "x"))) == []
