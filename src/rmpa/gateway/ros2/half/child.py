"""ROS 2's half of the gateway: a process under ROS 2's own Python that does with rclpy what the gateway asks.

It needs the standard library and rclpy, and the syntax of Python 3.8; nothing of rmpa is imported. Its argument is
the descriptor of a socket to the gateway. Frames go both ways, little-endian::

    4 bytes  length of what follows
    1 byte   operation
    4 bytes  id of the endpoint
    n bytes  JSON, or as below

From the gateway:

``H``  JSON ``{"protocol": 1, "domain": 0, "name": "gateway"}``, once and first
``+``  create: JSON ``{"kind", "node", "name", "type", "qos"}``; ``kind`` as in rmw_zenoh's tokens (MP, MS, SS, SC)
``-``  take it back
``M``  publish: the message as CDR
``Q``  call: the number of the call, 8 bytes, and the request as CDR
``A``  answer a call: its number, 8 bytes, 1 byte that is 0 or 1 (whether it succeeded), and the response as CDR

To the gateway:

``H``  JSON: ``protocol``, ``distribution``, ``rmw``, ``python``, ``gids`` (whether messages tell their publisher),
       ``prefix`` (of the GIDs of this process)
``!``  an endpoint was not created, or its QoS fits no other one: JSON ``{"text"}``
``G``  the graph: JSON ``{"nodes": [...], "added": [...], "removed": [...]}``
``M``  a message: length of the GID (1 byte), the GID, source stamp (8), sequence number (8), then CDR
``Q``  a request: the number of the call, 8 bytes, and CDR
``A``  an answer: as from the gateway; of a call that failed the text of the error
"""

from __future__ import annotations

import collections
import importlib
import json
import os
import socket
import struct
import sys
import threading
import time
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from .branches import GraphGuard, Taker, Waits, distribution, event_callbacks, handle_of, ignore, look_at_events

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

PROTOCOL = 1
_HEAD = struct.Struct("<IBI")
_CALL = struct.Struct("<Q")
_STAMPS = struct.Struct("<qq")
_SHORT = 5
# The namespace of the nodes that gateways show.
_OWN = "/rmpa/"
# Messages of which it is known that their echo has not come; for rclpys that do not tell a message's publisher.
_ECHOES = 10000
# Seconds between two looks at the endpoints of every topic, whatever is told.
_WHOLE_PERIOD = 5.0
# Seconds between two looks at names where no change is told, and between two looks at the least.
_POLL_PERIOD = 0.25
_LEAST_PERIOD = 0.05
# The names of the node of an endpoint that has none, or of which it is not known yet (rmw_dds_common).
_NAMELESS = ("_NODE_NAME_UNKNOWN_", "_CREATED_BY_BARE_DDS_APP_")
# Seconds within which that is known: twice the period at which DDS repeats what was lost.
_NAMING_PERIOD = 6.0
# Hexadecimal digits of a GID that the participant of DDS has.
_PARTICIPANT = 24
_INFINITE = 2**63 - 1
# What a QoS is made of, beside its depth, by the names of the gateway: the enumerations and times of rclpy.
_POLICIES = {
    "reliability": "ReliabilityPolicy",
    "durability": "DurabilityPolicy",
    "history": "HistoryPolicy",
    "liveliness": "LivelinessPolicy",
}
_TIMES = {"deadline": "deadline", "lifespan": "lifespan", "lease": "liveliness_lease_duration"}


class Pipe:
    """The socket to the gateway; frames are written by any thread."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._lock = threading.Lock()

    def send(self, operation: str, number: int, *parts: Any) -> None:
        """Write one frame; a gateway that is slow is waited for, so that queues of ROS 2 decide what is dropped."""
        size = sum(map(len, parts))
        head = _HEAD.pack(size + _SHORT, ord(operation), number)
        with self._lock:
            sent = self._sock.sendmsg((head, *parts))
            if sent < _HEAD.size + size:
                self._sock.sendall(b"".join((head, *parts))[sent:])

    def say(self, operation: str, number: int, **fields: Any) -> None:
        """Write one frame of JSON."""
        self.send(operation, number, json.dumps(fields).encode())

    def read(self) -> tuple[str, int, bytes]:
        """The next frame.

        Raises:
            EOFError: The gateway has ended.
        """
        size, operation, number = _HEAD.unpack(self._exactly(_HEAD.size))
        return chr(operation), number, self._exactly(size - _SHORT)

    def _exactly(self, size: int) -> bytes:
        data = self._sock.recv(size, socket.MSG_WAITALL)
        while len(data) < size:
            more = self._sock.recv(size - len(data), socket.MSG_WAITALL)
            if not more:
                raise EOFError
            data += more
        return data


class Watcher:
    """Looks at what ROS 2 has, when something has changed, or again and again where nothing tells of that."""

    def __init__(self, node: Any, say: Callable[..., None]) -> None:
        self._node = node
        self._say = say
        self._names: Any = None
        self._known: dict[str, dict[str, Any]] = {}
        self._nodes: Any = None
        # When an endpoint without a node was seen first, by GID.
        self._nameless: dict[str, float] = {}
        self._looked = self._whole = self._earliest = 0.0

    def due(self, *, told: bool, changed: bool) -> float:
        """When to look next, by the steady clock; ``told``: a change is told, and one was."""
        period = _WHOLE_PERIOD if told else _POLL_PERIOD
        return self._earliest if changed else self._looked + period

    def look(self, now: float, *, changed: bool) -> bool:
        """Tell the gateway what has changed; return whether to look again soon."""
        node = self._node
        nodes = sorted(set(node.get_node_names_and_namespaces()))
        topics = sorted(name for name, _ in node.get_topic_names_and_types())
        names = nodes, topics, sorted(name for name, _ in node.get_service_names_and_types())
        self._looked, again = now, False
        if changed or names != self._names or now >= self._whole + _WHOLE_PERIOD:
            self._names, self._whole = names, now
            again = self._compare(nodes, topics)
        # Looking takes a tenth of the time at the most.
        self._earliest = now + max(_LEAST_PERIOD, 10 * (time.monotonic() - now))
        return again

    def _compare(self, nodes: list[tuple[str, str]], topics: list[str]) -> bool:
        found = {row["gid"]: row for name in topics for row in self._endpoints(name)}
        again = found.pop("", None) is not None
        shown = []
        for base, namespace in nodes:
            try:
                services = self._node.get_service_names_and_types_by_node(base, namespace)
            except Exception:  # the node has just gone
                continue
            owner = namespace.rstrip("/") + "/" + base
            shown.append(owner)
            for name, types in services:
                for kind_of in types:
                    key = "%s %s %s" % (owner, name, kind_of)
                    found[key] = _told(key, "SS", owner, name, kind_of, _service_hash(kind_of), {})
        added = [each for key, each in found.items() if key not in self._known]
        removed = [key for key in self._known if key not in found]
        if not again:
            self._nameless.clear()
        self._known = found
        if added or removed or shown != self._nodes:
            self._nodes = shown
            self._say("G", 0, nodes=shown, added=added, removed=removed)
        return again

    def _endpoints(self, name: str) -> Iterator[dict[str, Any]]:
        """Those of a topic; one without a GID stands for those of which the node is not known yet."""
        for kind, infos in (
            ("MP", self._node.get_publishers_info_by_topic(name)),
            ("MS", self._node.get_subscriptions_info_by_topic(name)),
        ):
            for info in infos:
                gid = bytes(info.endpoint_gid).hex()
                if gid in self._known:
                    yield self._known[gid]
                    continue
                owner = info.node_namespace.rstrip("/") + "/" + info.node_name
                if info.node_name.startswith(_NAMELESS):
                    # Programs of plain DDS have no node; what names that of others may be late by seconds.
                    if time.monotonic() < self._nameless.setdefault(gid, time.monotonic()) + _NAMING_PERIOD:
                        yield {"gid": ""}
                        continue
                    owner = "/dds_" + gid[_PARTICIPANT - 8 : _PARTICIPANT]
                type_hash = str(getattr(info, "topic_type_hash", "") or "")
                yield _told(gid, kind, owner, name, info.topic_type, type_hash, _told_qos(info.qos_profile))


def _told(gid: str, kind: str, node: str, name: str, kind_of: str, type_hash: str, qos: Any) -> dict[str, Any]:
    return {"gid": gid, "kind": kind, "node": node, "name": name, "type": kind_of, "hash": type_hash, "qos": qos}


def _told_qos(profile: Any) -> dict[str, int]:
    """A QoS for the gateway: the numbers of rmw/types.h, times in nanoseconds."""
    told = {name: int(getattr(profile, name)) for name in _POLICIES}
    if profile.depth:
        told["depth"] = profile.depth
    for name, attribute in _TIMES.items():
        value = getattr(profile, attribute).nanoseconds
        if 0 < value < _INFINITE:
            told[name] = value
    return told


_HASHES: dict[str, str] = {}


def _service_hash(name: str) -> str:
    """The hash of a service type, from the description that its package has installed; empty: there is none."""
    if name not in _HASHES:
        _HASHES[name] = ""
        package, kind, base = name.split("/")
        file_name = (base.rpartition("_")[0] if kind == "action" else base) + ".json"
        try:
            folder = os.path.dirname(importlib.import_module(package).__file__ or "")
            while not os.path.isdir(os.path.join(folder, "share", package)):
                if folder == os.path.dirname(folder):
                    return ""
                folder = os.path.dirname(folder)
            with open(os.path.join(folder, "share", package, kind, file_name)) as file:
                for each in json.load(file)["type_hashes"]:
                    if each["type_name"] == name:
                        _HASHES[name] = each["hash_string"]
        except (ImportError, OSError, ValueError, KeyError):  # before Iron, or a package that is not installed here
            pass
    return _HASHES[name]


def read_qos(given: dict[str, int]) -> Any:
    """The QoS as the gateway writes it: what differs from rmw's defaults, in the form of ``_told_qos``."""
    from rclpy import qos
    from rclpy.duration import Duration

    fields: dict[str, Any] = {"depth": given.get("depth", 10)}
    fields.update((name, getattr(qos, kind)(given[name])) for name, kind in _POLICIES.items() if name in given)
    fields.update((key, Duration(nanoseconds=given[name])) for name, key in _TIMES.items() if name in given)
    return qos.QoSProfile(**fields)


def load_type(name: str) -> Any:
    """The class of ``package/msg/Name``, ``package/srv/Name``, or a part of an action as ROS 2 names it.

    Raises:
        LookupError: It is not installed; the text names the package.
    """
    package, kind, base = name.split("/")
    try:
        module = importlib.import_module("%s.%s" % (package, kind))
    except ImportError as error:
        raise LookupError(
            "ROS 2 has no package %s here (%s): install ros-%s-%s, or source the workspace that has it"
            % (package, error, os.environ.get("ROS_DISTRO") or "<distribution>", package.replace("_", "-"))
        )
    try:
        if kind != "action":
            return getattr(module, base)
        action, _, part = base.rpartition("_")
        implementation = getattr(module, action).Impl
        parts = {"SendGoal": "SendGoalService", "GetResult": "GetResultService", "FeedbackMessage": "FeedbackMessage"}
        return getattr(implementation, parts[part])
    except (AttributeError, KeyError):
        raise LookupError("the package %s of ROS 2 has no %s here: it is older or newer" % (package, name))


@dataclass(eq=False)
class Made:
    """One publisher, subscription, server or client that was made for the gateway.

    Attributes:
        calls: Of a server the header of each call that waits; of a client the calls by rcl's numbers.
    """

    number: int
    kind: str
    name: str
    node: str
    entity: Any
    handle: Any
    type: Any
    calls: dict[int, Any] = field(default_factory=dict)


class Half:
    """The endpoints, and the loop that takes what arrives for them."""

    def __init__(self, link: Pipe, rclpy: Any, domain: int, name: str) -> None:
        from rclpy.impl.implementation_singleton import rclpy_implementation

        self._link = link
        self._rclpy = rclpy
        self._native = rclpy_implementation
        self._context = rclpy.Context()
        os.environ["ROS_DOMAIN_ID"] = str(domain)  # Foxy has no argument for it
        rclpy.init(args=[], context=self._context)
        self._nodes: dict[str, tuple[Any, list[int]]] = {}
        self._own = self._make_node(_OWN + name)
        self._endpoints: dict[int, Made] = {}
        self._tasks: collections.deque[tuple[str, int, bytes]] = collections.deque()
        # What waits in it, by endpoint.
        self._waiting: collections.Counter[int] = collections.Counter()
        self._lock = threading.Lock()
        self._wake = rclpy.guard_condition.GuardCondition(None, None, context=self._context)
        self._wake_handle = handle_of(self._native, self._wake)
        self._waits: Any = None
        self.taker = Taker()
        self._graph = Watcher(self._own, link.say)
        self._guard = GraphGuard(self._own)
        self._requests = 0
        self._operations = {
            "+": self._create,
            "-": self._destroy,
            "M": self._publish,
            "Q": self._call,
            "A": self._answer,
        }
        # Messages of our own that have not come back yet, by topic and hash.
        self._echoes: collections.Counter[tuple[str, int]] = collections.Counter()

    def start(self) -> None:
        """Say what this is."""
        from std_msgs.msg import String

        self.taker.check(self._own, String, read_qos({}), partial(handle_of, self._native))
        self._link.say(
            "H",
            0,
            protocol=PROTOCOL,
            distribution=distribution(),
            rmw=self._native.rclpy_get_rmw_implementation_identifier(),
            python="%d.%d" % sys.version_info[:2],
            gids=self.taker.gids,
            prefix=self.taker.prefix.hex(),
        )

    def read(self) -> None:
        """Handle frames until the gateway ends; what changes the wait set is done by the loop."""
        while True:
            operation, number, body = self._link.read()
            # A message goes at once, but not before its publisher is made, nor before earlier ones that wait for it.
            if operation == "M" and number in self._endpoints and not self._waiting[number]:
                self._publish(number, body)
                continue
            with self._lock:
                self._waiting[number] += 1
            self._tasks.append((operation, number, body))
            self._wake.trigger()

    def _publish(self, number: int, body: bytes) -> None:
        endpoint = self._endpoints.get(number)
        if endpoint is None:
            return  # it could not be made, or is taken back
        if not self.taker.gids and len(self._echoes) < _ECHOES:
            self._echoes[endpoint.name, hash(body)] += 1
        try:
            endpoint.entity.publish(body)
        except Exception:
            if number in self._endpoints:  # else it was taken back in this moment
                raise

    def _do(self, operation: str, number: int, body: bytes) -> None:
        self._operations[operation](number, body)
        with self._lock:
            self._waiting[number] -= 1
            if not self._waiting[number]:
                del self._waiting[number]

    def _make_node(self, name: str) -> Any:
        namespace, _, base = name.rpartition("/")
        options = {"start_parameter_services": False, "enable_rosout": False}
        return self._rclpy.create_node(base, context=self._context, namespace=namespace or "/", **options)

    def _create(self, number: int, body: bytes) -> None:
        asked = json.loads(body)
        name, kind = asked["node"], asked["kind"]
        try:
            kind_of = load_type(asked["type"])
            if name not in self._nodes:
                self._nodes[name] = self._make_node(name), []
            node, users = self._nodes[name]
            qos = read_qos(asked["qos"])
            if kind == "MP":
                entity = node.create_publisher(
                    kind_of, asked["name"], qos, event_callbacks=self._events(number, True)
                )
            elif kind == "MS":
                events = self._events(number, False)
                entity = node.create_subscription(
                    kind_of, asked["name"], ignore, qos, raw=True, event_callbacks=events
                )
            elif kind == "SS":
                entity = node.create_service(kind_of, asked["name"], ignore)
            else:
                entity = node.create_client(kind_of, asked["name"])
        except Exception as error:  # of rcl, rmw, the DDS library, or the type
            self._link.say("!", number, text=str(error) or type(error).__name__)
            return
        users.append(number)
        handle = handle_of(self._native, entity)
        self._endpoints[number] = Made(number, kind, asked["name"], name, entity, handle, kind_of)
        self._waits = None

    def _events(self, number: int, publishes: bool) -> Any:
        """Callbacks that tell of a QoS that fits no other endpoint."""

        def incompatible(info: Any) -> None:
            policy = str(getattr(info.last_policy_kind, "name", info.last_policy_kind))
            policy = policy.replace("RMW_QOS_POLICY_", "").lower()
            self._link.say("!", number, policy=policy, count=info.total_count)

        return event_callbacks(publishes, incompatible)

    def _destroy(self, number: int, _body: bytes) -> None:
        endpoint = self._endpoints.pop(number, None)
        if endpoint is None:
            return
        self._waits = None
        node, users = self._nodes[endpoint.node]
        destroy = {
            "MP": node.destroy_publisher,
            "MS": node.destroy_subscription,
            "SS": node.destroy_service,
            "SC": node.destroy_client,
        }
        destroy[endpoint.kind](endpoint.entity)
        users.remove(number)
        if not users:
            del self._nodes[endpoint.node]
            node.destroy_node()

    def _call(self, number: int, body: bytes) -> None:
        from rclpy.serialization import deserialize_message

        endpoint, call = self._endpoints.get(number), body[: _CALL.size]
        try:
            if endpoint is None:
                raise LookupError("the client was not created")
            if not endpoint.entity.service_is_ready():
                raise LookupError("no server of ROS 2 is there")
            request = deserialize_message(body[_CALL.size :], endpoint.type.Request)
            endpoint.calls[endpoint.handle.send_request(request)] = call
        except Exception as error:
            self._link.send("A", number, call, b"\0", str(error).encode())

    def _answer(self, number: int, body: bytes) -> None:
        from rclpy.serialization import deserialize_message

        endpoint = self._endpoints.get(number)
        header = endpoint.calls.pop(_CALL.unpack_from(body)[0], None) if endpoint is not None else None
        if endpoint is None or header is None or not body[_CALL.size]:
            return  # ROS 2 has no response that says that a call has failed
        response = deserialize_message(body[_CALL.size + 1 :], endpoint.type.Response)
        endpoint.handle.service_send_response(response, header)

    def spin(self) -> None:
        """Take what arrives, do what was asked, and look at the graph, for ever."""
        takes = {"MS": self._messages, "SC": self._responses, "SS": self._requests_of}
        changed = True
        while True:
            now, told = time.monotonic(), bool(self._guard.pointer)
            if now >= self._graph.due(told=told, changed=changed):
                changed = self._graph.look(now, changed=changed)
                look_at_events(self._native, self._context, [each.entity for each in self._endpoints.values()])
            if self._waits is None:
                self._waits = Waits(
                    self._native, self._context, self._endpoints.values(), self._wake_handle, self._guard
                )
            ready = self._waits.wait(self._graph.due(told=told, changed=changed) - now)
            changed = changed or self._waits.graph_changed
            for endpoint in ready:
                takes[endpoint.kind](endpoint)
            while self._tasks:
                self._do(*self._tasks.popleft())

    def _messages(self, endpoint: Made) -> None:
        take, handle, kind_of = self.taker.take, endpoint.handle, endpoint.type
        for _ in range(16):  # then the others have their turn
            taken = take(handle, kind_of)
            if taken is None:
                return
            data, gid, stamp, number = taken
            if self._is_own(endpoint.name, gid, data):
                continue
            self._link.send("M", endpoint.number, bytes((len(gid),)), gid, _STAMPS.pack(stamp, number), data)

    def _is_own(self, name: str, gid: bytes, data: bytes) -> bool:
        if self.taker.gids:
            return self.taker.is_own(gid)
        key = name, hash(data)
        if not self._echoes[key]:
            return False
        self._echoes[key] -= 1
        return True

    def _responses(self, endpoint: Made) -> None:
        from rclpy.serialization import serialize_message

        header, response = endpoint.handle.take_response(endpoint.type.Response)
        if header is None:
            return
        number = getattr(header, "request_id", header).sequence_number
        call = endpoint.calls.pop(number, None)
        if call is not None:
            self._link.send("A", endpoint.number, call, b"\1", serialize_message(response))

    def _requests_of(self, endpoint: Made) -> None:
        from rclpy.serialization import serialize_message

        request, header = endpoint.handle.service_take_request(endpoint.type.Request)
        if request is None:
            return
        self._requests += 1
        endpoint.calls[self._requests] = getattr(header, "request_id", header)
        self._link.send("Q", endpoint.number, _CALL.pack(self._requests), serialize_message(request))


def main() -> int:
    """Serve the gateway until it ends."""
    link = Pipe(socket.socket(fileno=int(sys.argv[1])))
    operation, _, body = link.read()
    asked = json.loads(body)
    if operation != "H" or asked.get("protocol") != PROTOCOL:
        link.say("!", 0, text="this half speaks protocol %d" % PROTOCOL)
        return 1
    try:
        import rclpy
        import rclpy.guard_condition
        import rclpy.node
    except ImportError as error:
        link.say("!", 0, text="it has no rclpy (%s)" % error)
        return 1
    half = Half(link, rclpy, asked["domain"], asked["name"])
    half.start()

    def read() -> None:
        try:
            half.read()
        except Exception as error:
            if not isinstance(error, (EOFError, OSError)):
                sys.stderr.write("rmpa gateway: ROS 2's half: %r\n" % error)
        os._exit(0)  # DDS takes seconds to end in order; the gateway is gone

    threading.Thread(target=read, daemon=True).start()
    half.spin()
    return 0
