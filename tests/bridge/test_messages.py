from __future__ import annotations

import contextlib
import json
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.bridge import limits, messages
from rmpa.bridge.messages import (
    Advertise,
    AdvertiseServices,
    Audience,
    CloseRoute,
    CloseService,
    Description,
    Message,
    Mismatch,
    Notification,
    OpenRoute,
    OpenService,
    Origin,
    Request,
    Response,
    RouteClosed,
    RouteOpened,
    ServiceClosed,
    ServiceOffer,
    ServiceOpened,
    Source,
    TopicOffer,
    decode,
    encode,
)
from rmpa.core import limits as core_limits
from rmpa.core.contract import (
    Contract,
    Durability,
    History,
    Liveliness,
    Priority,
    Reliability,
    Transport,
    combine,
)
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.mesh import limits as mesh_limits

DEFAULT = (
    b'"contract":{"reliability":"best_effort","durability":"volatile","history":"keep_last",'
    b'"deadline":null,"lifespan":null,"liveliness":"automatic","liveliness_lease":null,"priority":"normal",'
    b'"max_rate":null,"transport":"relay"}'
)
STRICT = Contract(
    Reliability.RELIABLE,
    Durability.TRANSIENT_LOCAL,
    History.KEEP_ALL,
    depth=5,
    deadline=0.5,
    lifespan=2.0,
    liveliness=Liveliness.MANUAL_BY_TOPIC,
    liveliness_lease=1.0,
    priority=Priority.HIGH,
    max_rate=30.0,
    outage=300.0,
    transport=Transport.AUTO,
)
STRICT_BYTES = (
    b'"contract":{"reliability":"reliable","durability":"transient_local","history":"keep_all","depth":5,'
    b'"deadline":0.5,"lifespan":2.0,"liveliness":"manual_by_topic","liveliness_lease":1.0,"priority":"high",'
    b'"max_rate":30.0,"outage":300.0,"transport":"auto"}'
)
PAD, R = "0" * 31 + "1", "f" * 32
ADD_MD5 = "6a2e34150c00229791cc89ff309fff21"


def relayed(**changed: object) -> bytes:
    """An offer whose origin is not as it should be."""
    origin = {"name": "pad", "guid": "10.0.0.1:4000#7", "instance": PAD, "node": "/joy", "path": [R], **changed}
    offer = {"topic": "/a", "node": "/b", "type": "a/B", "origin": origin}
    return json.dumps({"op": "advertise", "added": [offer]}).encode()


GOLDEN: list[tuple[Message, bytes]] = [
    (
        Advertise(added=(TopicOffer("/cmd", "/joy", "sensor_msgs/Joy"),), full=True),
        (
            b'{"op":"advertise","added":[{"topic":"/cmd","node":"/joy","type":"sensor_msgs/Joy"}],'
            b'"removed":[],"full":true,"more":false}'
        ),
    ),
    (
        Advertise(
            added=(
                TopicOffer(
                    "/cmd", "/rmpa/pad/joy", "sensor_msgs/Joy", Origin("pad", "10.0.0.1:4000#7", PAD, "/joy", (R,))
                ),
            )
        ),
        (
            b'{"op":"advertise","added":[{"topic":"/cmd","node":"/rmpa/pad/joy","type":"sensor_msgs/Joy","origin":'
            b'{"name":"pad","guid":"10.0.0.1:4000#7","instance":"'
            + PAD.encode()
            + b'","node":"/joy","path":["'
            + R.encode()
            + b'"]}}],"removed":[],"full":false,"more":false}'
        ),
    ),
    (
        Advertise(removed=(Source("/cmd", "/joy"),)),
        b'{"op":"advertise","added":[],"removed":[{"topic":"/cmd","node":"/joy"}],"full":false,"more":false}',
    ),
    (
        OpenRoute(7, "/cmd", "/joy"),
        b'{"op":"open","route":7,"topic":"/cmd","node":"/joy",' + DEFAULT + b',"epoch":0,"after":0}',
    ),
    (
        OpenRoute(7, "/cmd", "/joy", STRICT, epoch=3, after=4711),
        (b'{"op":"open","route":7,"topic":"/cmd","node":"/joy",' + STRICT_BYTES + b',"epoch":3,"after":4711}'),
    ),
    (
        RouteOpened(7, Description("sensor_msgs/Joy", "5a9ea5f83505693b71e785041e67a8bb", "Header header\n", True)),
        (
            b'{"op":"opened","route":7,"description":{"type":"sensor_msgs/Joy","md5":"5a9ea5f83505693b71e785041e67a8bb",'
            b'"definition":"Header header\\n","latching":true},' + DEFAULT + b',"epoch":0,"first":1}'
        ),
    ),
    (
        RouteOpened(7, Description("a/B", ADD_MD5, "", False), STRICT, 3, 1, following=4711),
        (
            b'{"op":"opened","route":7,"description":{"type":"a/B","md5":"6a2e34150c00229791cc89ff309fff21",'
            b'"definition":"","latching":false},' + STRICT_BYTES + b',"epoch":3,"first":1,"following":4711}'
        ),
    ),
    (
        RouteOpened(7, Description("a/B", ADD_MD5, "", False), epoch=4, unknown=True),
        (
            b'{"op":"opened","route":7,"description":{"type":"a/B","md5":"6a2e34150c00229791cc89ff309fff21",'
            b'"definition":"","latching":false},' + DEFAULT + b',"epoch":4,"first":1,"unknown":true}'
        ),
    ),
    (CloseRoute(7), b'{"op":"close","route":7}'),
    (RouteClosed(7, "the node has gone"), b'{"op":"closed","route":7,"reason":"the node has gone"}'),
    (
        Mismatch("/cmd", "/joy", "/base", "md5"),
        b'{"op":"mismatch","topic":"/cmd","node":"/joy","subscriber":"/base","text":"md5"}',
    ),
    (Audience(7, ("/arm", "/move_base")), b'{"op":"audience","route":7,"nodes":["/arm","/move_base"]}'),
    (
        AdvertiseServices(
            added=(ServiceOffer("/add", "/rmpa/a/b", Origin("a", "10.0.0.1:4000#7", PAD, "/b", (R, R))),)
        ),
        (
            b'{"op":"services","added":[{"service":"/add","node":"/rmpa/a/b","origin":{"name":"a","guid":'
            b'"10.0.0.1:4000#7","instance":"'
            + PAD.encode()
            + b'","node":"/b","path":["'
            + R.encode()
            + b'","'
            + R.encode()
            + b'"]}}],"removed":[],"full":false,"more":false}'
        ),
    ),
    (
        AdvertiseServices(added=(ServiceOffer("/add", "/adder"),), full=True),
        b'{"op":"services","added":[{"service":"/add","node":"/adder"}],"removed":[],"full":true,"more":false}',
    ),
    (
        AdvertiseServices(removed=("/add",), more=True),
        b'{"op":"services","added":[],"removed":["/add"],"full":false,"more":true}',
    ),
    (
        OpenService(1 << 31 | 1, "/add", 2.5),
        b'{"op":"service_open","route":2147483649,"service":"/add","timeout":2.5}',
    ),
    (
        ServiceOpened(1 << 31 | 1, 1 << 31 | 2, "a/Add", ADD_MD5, "a/AddRequest", "a/AddResponse"),
        (
            b'{"op":"service_opened","route":2147483649,"requests":2147483650,"type":"a/Add",'
            b'"md5":"6a2e34150c00229791cc89ff309fff21","request_type":"a/AddRequest","response_type":"a/AddResponse"}'
        ),
    ),
    (CloseService(1 << 31 | 1), b'{"op":"service_close","route":2147483649}'),
    (
        ServiceClosed(1 << 31 | 1, "its server has gone"),
        b'{"op":"service_closed","route":2147483649,"reason":"its server has gone"}',
    ),
    (Request(3, "param.get", {"key": "/a"}), b'{"op":"ask","number":3,"what":"param.get","args":{"key":"/a"}}'),
    (
        Response(3, ok=False, error="no /a", remedy="set it"),
        b'{"op":"answer","number":3,"ok":false,"value":null,"error":"no /a","remedy":"set it"}',
    ),
    (Notification("param.changed", {"key": "/a"}), b'{"op":"tell","what":"param.changed","args":{"key":"/a"}}'),
]


@pytest.mark.parametrize(("message", "wire"), GOLDEN)
def test_golden_bytes(message: Message, wire: bytes) -> None:
    assert encode(message) == wire
    assert decode(wire) == message
    assert decode(memoryview(wire)) == message


@pytest.mark.parametrize(
    "wire",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b'{"op":"unheard-of"}',
        b'{"route":7}',
        b'{"op":"open","route":7}',
        b'{"op":"open","route":0,"topic":"/a","node":"/b"}',
        b'{"op":"open","route":4294967296,"topic":"/a","node":"/b"}',
        b'{"op":"open","route":-1,"topic":"/a","node":"/b"}',
        b'{"op":"open","route":1,"topic":"a","node":"/b"}',
        b'{"op":"open","route":1,"topic":"/a","node":"/b/"}',
        b'{"op":"open","route":1,"topic":"/a//c","node":"/b"}',
        b'{"op":"open","route":1,"topic":"/\xff","node":"/b"}',
        b'{"op":"open","route":1,"topic":"/a\\nb","node":"/b"}',
        b'{"op":"advertise","added":[{"topic":"/a","node":"/b","type":"*"}]}',
        b'{"op":"advertise","added":[{"topic":"/a","node":"/b","type":"String"}]}',
        b'{"op":"advertise","added":[{"topic":"","node":"/b","type":"a/B"}]}',
        b'{"op":"advertise","removed":[{"topic":"/a","node":""}]}',
        relayed(name="a b"),
        relayed(name=""),
        relayed(guid="10.0.0.1"),
        relayed(guid=1),
        relayed(instance="0" * 31),
        relayed(instance="G" * 32),
        relayed(node="joy"),
        relayed(path=[]),
        relayed(path=["f" * 32] * 5),
        relayed(path=["f" * 31]),
        relayed(path="f" * 32),
        relayed(path=[]).replace(b"advertise", b"services").replace(b"topic", b"service"),
        b'{"op":"opened","route":1,"description":{"type":"*","md5":"*","definition":"","latching":false}}',
        (
            b'{"op":"opened","route":1,"description":{"type":"a/B","md5":"5a9ea5f83505693b71e785041e67a8bb",'
            b'"definition":"\xe2\x82\xac","latching":false}}'
        ),
        b'{"op":"close","route":1}trailing',
        b'{"op":"open","route":1,"topic":"/' + b"x" * 1024 + b'","node":"/b"}',
        b'{"op":"advertise","added":[{"topic":"/a","node":"/b","type":"a/' + b"B" * 1024 + b'"}]}',
        b'{"op":"closed","route":1,"reason":"' + b"x" * 16385 + b'"}',
        b'{"op":"mismatch","topic":"/a","node":"/b","subscriber":"/c","text":"' + b"x" * 16385 + b'"}',
        b'{"op":"audience","route":0,"nodes":[]}',
        b'{"op":"audience","route":1,"nodes":["arm"]}',
        b'{"op":"audience","route":1,"nodes":["/arm\\n"]}',
        b'{"op":"audience","route":1,"nodes":null}',
        b'{"op":"audience","route":1,"nodes":[' + b'"/a",' * 64 + b'"/a"]}',
        b"[" * 100_000,
    ],
)
def test_what_is_not_a_message_is_the_peers_error(wire: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        decode(wire)


OPEN = b'{"op":"open","route":1,"topic":"/a","node":"/b"'
OPENED = (
    b'{"op":"opened","route":1,"description":{"type":"a/B","md5":"5a9ea5f83505693b71e785041e67a8bb",'
    b'"definition":"","latching":false}'
)


@pytest.mark.parametrize("beginning", [OPEN, OPENED], ids=["open", "opened"])
@pytest.mark.parametrize(
    "term",
    [
        '"depth":0', '"depth":100001', '"depth":1e3', '"depth":null', '"deadline":0', '"deadline":-1.5',
        '"deadline":0.0009', '"deadline":86401', '"deadline":1e999', '"deadline":NaN', '"deadline":Infinity',
        '"deadline":"1"', '"lifespan":0', '"liveliness_lease":-0.0', '"liveliness_lease":1e99', '"max_rate":0',
        '"max_rate":0.0009', '"max_rate":1e7', '"max_rate":NaN', '"max_rate":true', '"outage":0.9',
        '"outage":86401', '"outage":NaN', '"outage":null', '"outage":"5 min"', '"reliability":"sometimes"',
        '"durability":0', '"history":"RELIABLE"', '"liveliness":null', '"priority":"urgent"',
    ],
)  # fmt: skip
def test_a_contract_that_no_file_could_have_is_the_peers_error(beginning: bytes, term: str) -> None:
    with pytest.raises(RemoteProtocolError):
        decode(beginning + b',"contract":{' + term.encode() + b"}}")


@pytest.mark.parametrize(
    "term",
    [
        '"depth":1', '"depth":100000', '"deadline":0.001', '"deadline":86400', '"lifespan":null',
        '"max_rate":0.001', '"max_rate":1e6', '"outage":1', '"outage":86400', '"later_version":1e999',
    ],
)  # fmt: skip
def test_a_contract_at_its_bounds_is_taken(term: str) -> None:
    message = decode(OPEN + b',"contract":{' + term.encode() + b"}}")
    assert isinstance(message, OpenRoute)
    assert decode(encode(message)) == message


@pytest.mark.parametrize(
    "numbers",
    [
        OPEN + b',"epoch":-1', OPEN + b',"epoch":4294967296', OPEN + b',"epoch":1,"after":-1',
        OPEN + b',"epoch":1,"after":4294967296', OPEN + b',"epoch":1,"after":1e999',
        OPENED + b',"epoch":4294967296', OPENED + b',"epoch":1,"first":-1',
        OPENED + b',"epoch":1,"first":4294967296', OPENED + b',"epoch":null',
    ],
)  # fmt: skip
def test_numberings_have_32_bits(numbers: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        decode(numbers + b"}")


OF_BEFORE_TRANSPORTS = DEFAULT.replace(b',"transport":"relay"', b"")


LATER = DEFAULT.replace(b'"transport"', b'"outage":60.0,"term_of_a_later_version":[1,{"a":"b"}],"transport"')


@pytest.mark.parametrize(
    ("terms", "contract"),
    [
        pytest.param(b"", Contract(), id="before contracts"),
        pytest.param(b',"contract":{"reliability":"reliable"}', Contract(Reliability.RELIABLE), id="before outages"),
        pytest.param(b"," + OF_BEFORE_TRANSPORTS, Contract(), id="before transports"),
        pytest.param(b"," + LATER, Contract(outage=60.0), id="with a later term"),
    ],
)
def test_a_peer_of_another_release_is_understood(terms: bytes, contract: Contract) -> None:
    message = decode(OPEN + terms + b"}")
    assert message == OpenRoute(1, "/a", "/b", contract, epoch=0, after=0)
    assert combine(Contract(transport=Transport.DIRECT), contract).transport is Transport.RELAY
    assert contract.resume_window == (60.0 if terms.endswith(LATER) else core_limits.RESUME_WINDOW)


def test_an_unknown_transport_is_the_peers_error() -> None:
    with pytest.raises(RemoteProtocolError, match=r"Invalid enum value 'drect' - at `\$.contract.transport`"):
        decode(OPEN + b',"contract":{"transport":"drect"}}')


def test_a_message_beyond_the_limit_is_not_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_limits, "CONTROL_PAYLOAD_MAX", 10)
    with pytest.raises(LimitExceeded, match="control message of 24 bytes"):
        decode(b'{"op":"close","route":1}')


def test_too_many_topics_are_refused() -> None:
    offers = tuple(TopicOffer(f"/t{i}", "/n", "a/B") for i in range(limits.ADVERTISED_MAX + 1))
    with pytest.raises(RemoteProtocolError, match="added"):
        decode(encode(Advertise(added=offers)))


def test_fields_of_later_versions_are_ignored() -> None:
    assert decode(b'{"op":"close","route":1,"hurry":true}') == CloseRoute(1)


_names = st.from_regex(r"/[a-z][a-z0-9_]{0,8}(/[a-z][a-z0-9_]{0,8}){0,3}", fullmatch=True)
_types = st.from_regex(r"[a-z][a-z_]{0,8}/[A-Z][A-Za-z]{0,8}", fullmatch=True)
_md5s = st.from_regex(r"[0-9a-f]{32}", fullmatch=True)
_routes = st.integers(1, (1 << 31) - 1)
_numbers = st.integers(0, (1 << 32) - 1)
_times = st.none() | st.floats(core_limits.CONTRACT_TIME_MIN, core_limits.CONTRACT_TIME_MAX)
_contracts = st.builds(
    Contract,
    st.sampled_from(Reliability),
    st.sampled_from(Durability),
    st.sampled_from(History),
    st.integers(1, core_limits.CONTRACT_DEPTH_MAX),
    _times,
    _times,
    st.sampled_from(Liveliness),
    _times,
    st.sampled_from(Priority),
    st.none() | st.floats(core_limits.CONTRACT_RATE_MIN, core_limits.CONTRACT_RATE_MAX),
    st.floats(core_limits.OUTAGE_MIN, core_limits.OUTAGE_MAX),
    st.sampled_from(Transport),
)
_service_routes = st.integers(1 << 31, (1 << 32) - 1)
_services = st.builds(ServiceOffer, _names, _names)
_messages: st.SearchStrategy[Message] = st.one_of(
    st.builds(
        Advertise,
        added=st.lists(st.builds(TopicOffer, _names, _names, _types), max_size=5).map(tuple),
        removed=st.lists(st.builds(Source, _names, _names), max_size=5).map(tuple),
        full=st.booleans(),
        more=st.booleans(),
    ),
    st.builds(OpenRoute, _routes, _names, _names, _contracts, _numbers, _numbers),
    st.builds(
        RouteOpened,
        _routes,
        st.builds(Description, _types, _md5s, st.text(st.characters(max_codepoint=255)), st.booleans()),
        _contracts,
        _numbers,
        _numbers,
    ),
    st.builds(CloseRoute, _routes),
    st.builds(RouteClosed, _routes, st.text()),
    st.builds(Mismatch, _names, _names, st.text(), st.text()),
    st.builds(Audience, _routes, st.lists(_names, max_size=5).map(tuple)),
    st.builds(AdvertiseServices, st.lists(_services).map(tuple), st.lists(_names).map(tuple), st.booleans()),
    st.builds(OpenService, _service_routes, _names, st.floats(0.001, 3600)),
    st.builds(ServiceOpened, _service_routes, _service_routes, st.just("a/Add"), st.just(ADD_MD5)),
    st.builds(CloseService, _service_routes),
    st.builds(ServiceClosed, _service_routes, st.text()),
)


@given(_messages)
def test_every_message_survives_the_wire(message: Message) -> None:
    assert decode(encode(message)) == message


@given(st.binary(max_size=400))
def test_no_bytes_do_worse_than_a_protocol_error(wire: bytes) -> None:
    with contextlib.suppress(RemoteProtocolError):
        decode(wire)


@pytest.mark.parametrize(
    ("wire", "words"),
    [
        (b'{"op":"service_open","route":7,"service":"/add"}', "`$.route`"),
        (b'{"op":"service_open","route":4294967296,"service":"/add"}', "`$.route`"),
        (b'{"op":"service_open","route":2147483649,"service":"add"}', "`$.service`"),
        (b'{"op":"service_open","route":2147483649,"service":"/add","timeout":0}', "`$.timeout`"),
        (b'{"op":"service_open","route":2147483649,"service":"/add","timeout":1e9}', "`$.timeout`"),
        (b'{"op":"service_opened","route":2147483649,"requests":5,"type":"a/B","md5":"*"}', "`$.requests`"),
        (
            b'{"op":"service_opened","route":2147483649,"requests":2147483650,"type":"a/B","md5":"*"}',
            "`$.md5`",
        ),
        (b'{"op":"services","added":[{"service":"/add","node":"x y"}]}', "`$.added[0].node`"),
        (b'{"op":"services","removed":["add"]}', "`$.removed[0]`"),
    ],
)
def test_what_a_peer_may_not_say_of_services(wire: bytes, words: str) -> None:
    with pytest.raises(RemoteProtocolError) as caught:
        decode(wire)
    assert words in str(caught.value)


def test_every_message_has_golden_bytes() -> None:
    golden = {type(message) for message, _ in GOLDEN}
    assert golden == set(get_args(messages.Message))
