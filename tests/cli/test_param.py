"""``rmpa param`` against our own core, and against a fake agent's peer."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.bridge import limits
from rmpa.bridge.params import rules as transfer
from rmpa.cli.param import read_documents, read_yaml, write_yaml
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.observe.control_server import ControlServer
from rmpa.ros.wire.xmlrpc import parse_response, serialize_response
from tests.observe.samples import SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any

    from rmpa.ros.core.embedded import RosCore
    from tests.cli.conftest import Background, Place


def test_the_verbs(place: Place, core: RosCore) -> None:
    place.environ["ROS_MASTER_URI"] = core.uri
    assert place.run("param", "set", "/base", "{speed: 1.5, names: [a, 'on'], deep: {x: -3}}") == (0, "", "")
    assert place.run("param", "get", "/base/deep/x") == (0, "-3\n", "")
    assert place.run("param", "get", "/base") == (0, "deep:\n  x: -3\nnames:\n- a\n- 'on'\nspeed: 1.5\n", "")
    assert place.json("param", "get", "base", "--json") == [{"deep": {"x": -3}, "names": ["a", "on"], "speed": 1.5}]
    assert place.run("param", "set", "/base/deep", "-5") == (0, "", "")
    assert place.run("param", "list", "/base")[1].split() == ["/base/deep", "/base/names", "/base/speed"]
    code, _, err = place.run("param", "get", "/base/sped")
    assert (code, err.split("; ")[1]) == (1, "did you mean /base/speed? [unknown-name]\n")
    assert place.run("param", "dump", "base.yaml", "/base")[0] == 0
    assert place.run("param", "load", "base.yaml", "/copy")[0] == 0
    assert core.call("getParam", "/x", "/copy").value == core.call("getParam", "/x", "/base").value
    assert place.run("param", "delete", "/copy")[0] == 0
    assert place.run("param", "delete", "/copy")[0] == 1
    (place.path / "ns.yaml").write_text("_ns: inner\na: 1\n---\nb: 2\n")
    assert place.json("param", "load", "ns.yaml", "/outer", "--json") == [{"set": 2}]
    assert core.call("getParam", "/x", "/outer").value == {"inner": {"a": 1}, "b": 2}


@pytest.mark.parametrize(
    ("words", "code", "error"),
    [
        (("set", "/a", "[1,"), 1, "VALUE:1:4: not YAML"),
        (("set", "/a", "null"), 1, "VALUE: null is no value"),
        (("set", "/a", "{1: 2}"), 1, "the key 1 is not a string"),
        (("set", "/a", "99999999999"), 1, "does not fit the 32 bits"),
        (("set", "/a", "{b: 1, b: 2}"), 1, "found duplicate key"),
        (("set", "/a"), 2, "VALUE: none is given"),
        (("set", "/a", "1", "-t", "x"), 2, "VALUE: two are given"),
        (("set", "/", "5"), 1, "the root can only be set to a dictionary"),
        (("set", "/a", "{b: {'c d': 1}}"), 1, "'/a/b/c d' is not a parameter's name"),
        (("set", "/a", "-t", "nothing"), 1, "nothing cannot be read: No such file"),
        (("get", "~a"), 2, "private to a node"),
        (("get", "/a//b"), 2, "not a parameter's name"),
        (("delete", "/"), 2, "the root holds every parameter"),
        (("load", "list.yaml"), 1, "not a dictionary of parameters"),
        (("get", "/a", "--peer", "b", "--master", "http://x:1/"), 2, "--peer"),
        (("gte", "/a"), 2, "Did you mean `rmpa param get`?"),
    ],
)
def test_mistakes_change_nothing(place: Place, core: RosCore, words: tuple[str, ...], code: int, error: str) -> None:
    place.environ["ROS_MASTER_URI"] = core.uri
    (place.path / "list.yaml").write_text("- 1\n")
    found = place.run("param", *words)
    assert (found[0], found[1]) == (code, "")
    assert error in found[2]
    assert core.call("hasParam", "/x", "/a").value is False


@pytest.fixture
def peer(place: Place, background: Background) -> Iterator[dict[str, Any]]:
    """A fake agent whose only peer, base, has these parameters."""
    kept: dict[str, Any] = {"/speed": 1.5, "/big": "x" * (3 * limits.ASK_EXPRESS_MAX)}

    def ask(args: dict[str, object]) -> object:
        assert args["peer"] == "base"
        key = str(args.get("key"))
        match args["what"]:
            case transfer.GET if key not in kept:
                raise PeerRefused("base", f"there is no parameter {key}")
            case transfer.GET:
                return {"text": serialize_response(kept[key]).decode()}
            case transfer.NAMES:
                return {"text": serialize_response(list(kept)).decode()}
            case transfer.SET:
                kept[key] = parse_response(transfer.text_of(args).encode())
                return {"count": 1}
        del kept[key]
        return {}

    server = ControlServer(place.path, "pad", {"snapshot": lambda _: SNAPSHOT, "param": ask})
    background.do(server.start())
    yield kept
    background.do(server.close())


def test_a_peers(place: Place, peer: dict[str, Any]) -> None:
    assert place.run("param", "get", "--peer", "base", "/speed") == (0, "1.5\n", "")
    assert place.json("param", "get", "base:/big", "--json") == [peer["/big"]]
    assert place.run("param", "list", "--peer", "base") == (0, "/big\n/speed\n", "")
    assert place.run("param", "list", "base:/") == (0, "/big\n/speed\n", "")
    assert "names a peer too" in place.run("param", "get", "--peer", "arm", "base:/big")[2]
    (place.path / "text").write_text("é" * 40_000)
    assert place.json("param", "set", "--peer", "base", "/new", "-t", "text", "--json") == [{"key": "/new", "set": 1}]
    assert peer["/new"] == "é" * 40_000
    assert place.run("param", "delete", "--peer", "base", "/new") == (0, "", "")
    assert "/new" not in peer
    code, _, err = place.run("param", "get", "--peer", "base", "/nothing")
    assert code == 1
    assert "there is no parameter /nothing" in err


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
