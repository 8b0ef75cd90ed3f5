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
``+``  an endpoint was created: JSON ``{"gid"}``
``!``  it was not, or its QoS fits no other one: JSON ``{"text"}``
``G``  the graph: JSON ``{"nodes": [...], "added": [...], "removed": [...]}``
``M``  a message: length of the GID (1 byte), the GID, source stamp (8), sequence number (8), then CDR
``Q``  a request: the number of the call, 8 bytes, and CDR
``A``  an answer: as from the gateway; of a call that failed the text of the error
"""

from __future__ import annotations

import collections
import ctypes
import importlib
import json
import os
import socket
import struct
import sys
import threading
import time
from typing import Any

PROTOCOL = 1
_HEAD = struct.Struct("<IBI")
_CALL = struct.Struct("<Q")
_STAMPS = struct.Struct("<qq")
_SHORT = 5
# Seconds between two looks at ROS 2's graph, and between two that ask for the endpoints of every topic.
_LOOK_PERIOD = 0.25
_WHOLE_PERIOD = 5.0
# The namespace of the nodes that gateways show.
_OWN = "/rmpa/"
# The name of a node of which an endpoint was heard before the node (rcl's graph).
_UNKNOWN = "_NODE_NAME_UNKNOWN_"
# The distributions by the first release of rclpy that is of a later one.
_RCLPY_BELOW = (("foxy", 2), ("humble", 4), ("iron", 5), ("jazzy", 8), ("kilted", 10))
_INFINITE = 2**63 - 1
# Bytes of a GUID of DDS that its participant has (DDSI-RTPS 9.3.1).
_PARTICIPANT = 12
# Messages of which it is known that their echo has not come; for rclpys that do not tell a message's publisher.
_ECHOES = 10000
# The fields of rcutils_allocator_t, pointers all.
_ALLOCATOR = ("allocate", "deallocate", "reallocate", "zero_allocate", "state")
_POLICIES = {
    "reliability": {1: "RELIABLE", 2: "BEST_EFFORT"},
    "durability": {1: "TRANSIENT_LOCAL", 2: "VOLATILE"},
    "history": {1: "KEEP_LAST", 2: "KEEP_ALL"},
    "liveliness": {1: "AUTOMATIC", 2: "AUTOMATIC", 3: "MANUAL_BY_TOPIC"},
}


class Pipe:
    """The socket to the gateway; frames are written by any thread."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._lock = threading.Lock()

    def send(self, operation: str, number: int, *parts: bytes) -> None:
        """Write one frame; a gateway that is slow is waited for, so that queues of ROS 2 decide what is dropped."""
        size = sum(map(len, parts))
        with self._lock:
            self._sock.sendall(b"".join((_HEAD.pack(size + _SHORT, ord(operation), number), *parts)))

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
        data = bytearray(size)
        view = memoryview(data)
        while view:
            count = self._sock.recv_into(view)
            if not count:
                raise EOFError
            view = view[count:]
        return bytes(data)


class _ByteArray(ctypes.Structure):
    """rcutils/types/uint8_array.h, with its allocator."""

    _fields_ = [
        ("buffer", ctypes.POINTER(ctypes.c_uint8)),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        *[(name, ctypes.c_void_p) for name in _ALLOCATOR],
    ]


def _message_info(gid_size: int, numbered: bool) -> Any:
    """rmw_message_info_t of rmw/types.h: Foxy has no numbers, and GIDs have 24 bytes before Iron."""
    numbers = [("sequence", ctypes.c_uint64), ("reception", ctypes.c_uint64)] if numbered else []
    fields = [
        ("source_stamp", ctypes.c_int64),
        ("received_stamp", ctypes.c_int64),
        *numbers,
        ("implementation", ctypes.c_char_p),
        ("gid", ctypes.c_uint8 * gid_size),
        ("from_intra_process", ctypes.c_bool),
        ("reserve", ctypes.c_uint8 * 64),
    ]
    return type("MessageInfo", (ctypes.Structure,), {"_fields_": fields})


class Taker:
    """Takes serialized messages with the GID of their publisher.

    From Kilted on rclpy has it. Before, rcl is called by ctypes, with the structure that the check at the start has
    found to be right. Where neither does it, ``gids`` is false.
    """

    def __init__(self) -> None:
        self.gids = False
        # Of DDS: the first bytes of the GIDs of all endpoints of this process.
        self.prefix = b""
        self._info: Any = None
        self._rcl: Any = None
        self._array: Any = None

    def check(self, node: Any, message_type: Any, qos: Any) -> None:
        """Publish to ourselves, and see which way gives the publisher's GID."""
        name = "/rmpa/_gid_check_%d" % os.getpid()
        subscription = node.create_subscription(message_type, name, _ignore, qos, raw=True)
        publisher = node.create_publisher(message_type, name, qos)
        try:
            own = self._own_gid(node, name)
            for layout in (None, (16, True), (24, True), (24, False)):
                if layout is not None and not self._use(layout):
                    return
                for _ in range(20):
                    publisher.publish(b"\0\1\0\0\0\0\0\0")
                    time.sleep(0.02)
                    taken = self.take(subscription, message_type)
                    if taken is not None:
                        self.gids = bool(own) and taken[1][: len(own)] == own
                        break
                if self.gids:
                    self.prefix = own[:_PARTICIPANT]
                    return
            self._info = None
        finally:
            node.destroy_publisher(publisher)
            node.destroy_subscription(subscription)

    @staticmethod
    def _own_gid(node: Any, name: str) -> bytes:
        for _ in range(50):
            for info in node.get_publishers_info_by_topic(name):
                return bytes(info.endpoint_gid)
            time.sleep(0.02)
        return b""

    def _use(self, layout: tuple[int, bool]) -> bool:
        try:
            # rclpy has loaded it; where wheels have it elsewhere the symbols are in the process.
            rcl = ctypes.CDLL(_loaded("librcl.so"))
            self._rcl = rcl.rcl_take_serialized_message
        except (OSError, AttributeError):
            return False
        self._rcl.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        self._info = _message_info(*layout)()
        utils = ctypes.CDLL(_loaded("librcutils.so"))
        utils.rcutils_get_default_allocator.restype = _Allocator
        allocator = utils.rcutils_get_default_allocator()
        self._array = _ByteArray()
        for field in _ALLOCATOR:
            setattr(self._array, field, getattr(allocator, field))
        return True

    def take(self, subscription: Any, message_type: Any) -> tuple[bytes, bytes, int, int] | None:
        """The next message of a subscription with GID, source stamp (ns) and number; ``None``: there is none."""
        handle = subscription.handle
        if self._info is None:
            taken = handle.take_message(message_type, True)
            if taken is None:
                return None
            data, info = taken
            gid = info.get("publisher_gid") if isinstance(info, dict) else None
            number = info.get("publication_sequence_number") if isinstance(info, dict) else 0
            stamp = info["source_timestamp"] if isinstance(info, dict) else 0
            return data, _gid_bytes(gid), stamp, number or 0
        pointer = handle.pointer
        if self._rcl(pointer, ctypes.byref(self._array), ctypes.byref(self._info), None):
            return None
        info = self._info
        data = ctypes.string_at(self._array.buffer, self._array.length)
        return data, bytes(info.gid), info.source_stamp, getattr(info, "sequence", 0)


class _Allocator(ctypes.Structure):
    """rcutils_allocator_t."""

    _fields_ = [
        (name, ctypes.c_void_p) for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state")
    ]


def _gid_bytes(gid: Any) -> bytes:
    if gid is None:
        return b""
    return bytes(gid["data"] if isinstance(gid, dict) else gid)


def _loaded(name: str) -> str:
    """The path of a library that this process has loaded: in wheels its name has a hash behind."""
    stem = name.split(".", maxsplit=1)[0]
    with open("/proc/self/maps") as maps:
        for line in maps:
            path = line.split(None, 5)[5].strip() if line.count("/") else ""
            base = os.path.basename(path)
            if base.startswith((stem + ".", stem + "-")):
                return path
    return name


def _ignore(_message: Any) -> None:
    pass


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


class Made:
    """One publisher, subscription, server or client that was made for the gateway."""

    def __init__(self, number: int, kind: str, name: str, node: Any, entity: Any, kind_of: Any) -> None:
        self.number = number
        self.kind = kind
        self.name = name
        self.node = node
        self.entity = entity
        self.type = kind_of
        # Of a server: the header of each call that waits; of a client: the calls by rcl's numbers.
        self.calls: dict[int, Any] = {}


class Half:
    """The endpoints, and the loop that takes what arrives for them."""

    def __init__(self, link: Pipe, rclpy: Any, domain: int, name: str) -> None:
        from rclpy.impl.implementation_singleton import rclpy_implementation

        self._link = link
        self._rclpy = rclpy
        self._native = rclpy_implementation
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self._nodes: dict[str, tuple[Any, list[int]]] = {}
        self._own = self._make_node(_OWN + name)
        self._endpoints: dict[int, Made] = {}
        self._tasks: collections.deque[tuple[str, int, bytes]] = collections.deque()
        self._wake = rclpy.guard_condition.GuardCondition(None, None, context=self._context)
        self._wait_set: Any = None
        self.taker = Taker()
        self._graph = Watcher(self._own, link)
        self._requests = 0
        # Messages of our own that have not come back yet, by topic and hash.
        self._echoes: collections.Counter[tuple[str, int]] = collections.Counter()

    def start(self) -> None:
        """Say what this is."""
        from std_msgs.msg import String

        self.taker.check(self._own, String, _qos({}))
        self._link.say(
            "H",
            0,
            protocol=PROTOCOL,
            distribution=_distribution(),
            rmw=self._native.rclpy_get_rmw_implementation_identifier(),
            python="%d.%d" % sys.version_info[:2],
            gids=self.taker.gids,
            prefix=self.taker.prefix.hex(),
        )

    def read(self) -> None:
        """Handle frames until the gateway ends; what changes the wait set is done by the loop."""
        while True:
            operation, number, body = self._link.read()
            if operation == "M":
                endpoint = self._endpoints.get(number)
                if endpoint is not None:
                    if not self.taker.gids and len(self._echoes) < _ECHOES:
                        self._echoes[endpoint.name, hash(body)] += 1
                    endpoint.entity.publish(body)
            else:
                self._tasks.append((operation, number, body))
                self._wake.trigger()

    def _do(self, operation: str, number: int, body: bytes) -> None:
        if operation == "+":
            self._create(number, json.loads(body))
        elif operation == "-":
            self._destroy(number)
        elif operation == "Q":
            self._call(number, body)
        elif operation == "A":
            self._answer(number, body)

    def _make_node(self, name: str) -> Any:
        namespace, _, base = name.rpartition("/")
        options = {"start_parameter_services": False, "enable_rosout": False}
        return self._rclpy.create_node(base, context=self._context, namespace=namespace or "/", **options)

    def _create(self, number: int, asked: dict[str, Any]) -> None:
        name, kind = asked["node"], asked["kind"]
        try:
            kind_of = load_type(asked["type"])
            if name not in self._nodes:
                self._nodes[name] = self._make_node(name), []
            node, users = self._nodes[name]
            qos = _qos(asked["qos"])
            if kind == "MP":
                entity = node.create_publisher(
                    kind_of, asked["name"], qos, event_callbacks=self._events(number, True)
                )
            elif kind == "MS":
                events = self._events(number, False)
                entity = node.create_subscription(
                    kind_of, asked["name"], _ignore, qos, raw=True, event_callbacks=events
                )
            elif kind == "SS":
                entity = node.create_service(kind_of, asked["name"], _ignore)
            else:
                entity = node.create_client(kind_of, asked["name"])
        except Exception as error:  # of rcl, rmw, the DDS library, or the type
            self._link.say("!", number, text=str(error) or type(error).__name__)
            return
        users.append(number)
        self._endpoints[number] = Made(number, kind, asked["name"], node, entity, kind_of)
        self._wait_set = None
        self._link.say("+", number)

    def _events(self, number: int, publishes: bool) -> Any:
        """Callbacks that tell of a QoS that fits no other endpoint."""
        try:
            from rclpy import event_handler as events
        except ImportError:  # before Iron
            from rclpy import qos_event as events

        def incompatible(info: Any) -> None:
            policy = str(getattr(info.last_policy_kind, "name", info.last_policy_kind))
            policy = policy.replace("RMW_QOS_POLICY_", "").lower()
            self._link.say("!", number, policy=policy, count=info.total_count)

        made = events.PublisherEventCallbacks if publishes else events.SubscriptionEventCallbacks
        return made(incompatible_qos=incompatible, use_default_callbacks=False)

    def _destroy(self, number: int) -> None:
        endpoint = self._endpoints.pop(number, None)
        if endpoint is None:
            return
        self._wait_set = None
        node = endpoint.node
        destroy = {
            "MP": node.destroy_publisher,
            "MS": node.destroy_subscription,
            "SS": node.destroy_service,
            "SC": node.destroy_client,
        }
        destroy[endpoint.kind](endpoint.entity)
        for name, (each, users) in list(self._nodes.items()):
            if each is node:
                users.remove(number)
                if not users:
                    del self._nodes[name]
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
            endpoint.calls[endpoint.entity.handle.send_request(request)] = call
        except Exception as error:
            self._link.send("A", number, call, b"\0", str(error).encode())

    def _answer(self, number: int, body: bytes) -> None:
        from rclpy.serialization import deserialize_message

        endpoint = self._endpoints.get(number)
        header = endpoint.calls.pop(_CALL.unpack_from(body)[0], None) if endpoint is not None else None
        if endpoint is None or header is None or not body[_CALL.size]:
            return  # ROS 2 has no response that says that a call has failed
        response = deserialize_message(body[_CALL.size + 1 :], endpoint.type.Response)
        endpoint.entity.handle.service_send_response(response, header)

    def spin(self) -> None:
        """Take what arrives, do what was asked, and look at the graph, for ever."""
        due = 0.0
        while True:
            now = time.monotonic()
            if now >= due:
                due = now + _LOOK_PERIOD
                self._graph.look(now)
                self._look_at_events()
            self._wait(due - now)
            while self._tasks:
                self._do(*self._tasks.popleft())

    def _wait(self, timeout: float) -> None:
        kinds: dict[str, list[Made]] = {"MS": [], "SS": [], "SC": []}
        for endpoint in self._endpoints.values():
            if endpoint.kind in kinds:
                kinds[endpoint.kind].append(endpoint)
        counts = [len(kinds[kind]) for kind in ("MS", "SC", "SS")]
        if self._wait_set is None:
            self._wait_set = self._native.WaitSet(counts[0], 1, 0, counts[1], counts[2], 0, self._context.handle)
        wait_set = self._wait_set
        wait_set.clear_entities()
        for endpoint in kinds["MS"]:
            wait_set.add_subscription(endpoint.entity.handle)
        for endpoint in kinds["SC"]:
            wait_set.add_client(endpoint.entity.handle)
        for endpoint in kinds["SS"]:
            wait_set.add_service(endpoint.entity.handle)
        wait_set.add_guard_condition(self._wake.handle)
        wait_set.wait(max(0, int(timeout * 1e9)))
        for kind, word, take in (
            ("MS", "subscription", self._messages),
            ("SC", "client", self._responses),
            ("SS", "service", self._requests_of),
        ):
            if kinds[kind]:
                ready = set(wait_set.get_ready_entities(word))
                for endpoint in kinds[kind]:
                    if endpoint.entity.handle.pointer in ready:
                        take(endpoint)

    def _messages(self, endpoint: Made) -> None:
        for _ in range(16):  # then the others have their turn
            taken = self.taker.take(endpoint.entity, endpoint.type)
            if taken is None:
                return
            data, gid, stamp, number = taken
            if self._is_own(endpoint.name, gid, data):
                continue
            self._link.send("M", endpoint.number, bytes((len(gid),)), gid, _STAMPS.pack(stamp, number), data)

    def _is_own(self, name: str, gid: bytes, data: bytes) -> bool:
        if self.taker.gids:
            return gid[:_PARTICIPANT] == self.taker.prefix
        key = name, hash(data)
        if not self._echoes[key]:
            return False
        self._echoes[key] -= 1
        return True

    def _responses(self, endpoint: Made) -> None:
        from rclpy.serialization import serialize_message

        header, response = endpoint.entity.handle.take_response(endpoint.type.Response)
        if header is None:
            return
        number = getattr(header, "request_id", header).sequence_number
        call = endpoint.calls.pop(number, None)
        if call is not None:
            self._link.send("A", endpoint.number, call, b"\1", serialize_message(response))

    def _requests_of(self, endpoint: Made) -> None:
        from rclpy.serialization import serialize_message

        request, header = endpoint.entity.handle.service_take_request(endpoint.type.Request)
        if request is None:
            return
        self._requests += 1
        endpoint.calls[self._requests] = getattr(header, "request_id", header)
        self._link.send("Q", endpoint.number, _CALL.pack(self._requests), serialize_message(request))

    def _look_at_events(self) -> None:
        handlers = [
            handler
            for endpoint in self._endpoints.values()
            for handler in getattr(endpoint.entity, "event_handlers", ())
        ]
        if not handlers:
            return
        wait_set = self._native.WaitSet(0, 0, 0, 0, 0, len(handlers), self._context.handle)
        wait_set.clear_entities()
        for handler in handlers:
            handler.add_to_wait_set(wait_set)
        wait_set.wait(0)
        for handler in handlers:
            if handler.is_ready(wait_set):
                handler.callback(handler.take_data())


def _distribution() -> str:
    """The distribution of ROS 2, by its variable or the release of rclpy."""
    named = os.environ.get("ROS_DISTRO", "").lower()
    if named:
        return named
    try:
        from importlib.metadata import version

        release = [int(part) for part in version("rclpy").split(".")[:2]]
    except Exception:
        return ""
    return next((name for name, below in _RCLPY_BELOW if release[0] < below), "")


def _qos(given: dict[str, Any]) -> Any:
    """The QoS as the gateway writes it: the fields of rmw that differ from its defaults; times in nanoseconds."""
    from rclpy import qos
    from rclpy.duration import Duration

    fields: dict[str, Any] = {"depth": given.get("depth", 10)}
    kinds = (
        ("reliability", qos.ReliabilityPolicy),
        ("durability", qos.DurabilityPolicy),
        ("history", qos.HistoryPolicy),
        ("liveliness", qos.LivelinessPolicy),
    )
    for name, policy in kinds:
        if name in given:
            fields[name] = getattr(policy, given[name])
    for name, field in (("deadline", "deadline"), ("lifespan", "lifespan"), ("lease", "liveliness_lease_duration")):
        if name in given:
            fields[field] = Duration(nanoseconds=given[name])
    return qos.QoSProfile(**fields)


class Watcher:
    """What ROS 2 has, looked at again and again: rclpy tells of no change."""

    def __init__(self, node: Any, link: Pipe) -> None:
        self._node = node
        self._link = link
        self._names: Any = None
        self._known: dict[str, dict[str, Any]] = {}
        self._nodes: Any = None
        self._whole_at = 0.0

    def look(self, now: float) -> None:
        """Tell the gateway what has changed."""
        node = self._node
        nodes = sorted(set(node.get_node_names_and_namespaces()))
        topics = sorted((name, tuple(types)) for name, types in node.get_topic_names_and_types())
        by_node = []
        for base, namespace in nodes:
            try:
                by_node.append(
                    (
                        namespace.rstrip("/") + "/" + base,
                        tuple(map(_row, node.get_publisher_names_and_types_by_node(base, namespace))),
                        tuple(map(_row, node.get_subscriber_names_and_types_by_node(base, namespace))),
                        tuple(map(_row, node.get_service_names_and_types_by_node(base, namespace))),
                    )
                )
            except Exception:  # the node has just gone
                continue
        names = (topics, by_node)
        if names == self._names and now < self._whole_at:
            return
        self._names, self._whole_at = names, now + _WHOLE_PERIOD
        found: dict[str, dict[str, Any]] = {}
        for name, _ in topics:
            for kind, infos in (
                ("MP", node.get_publishers_info_by_topic(name)),
                ("MS", node.get_subscriptions_info_by_topic(name)),
            ):
                for info in infos:
                    if info.node_name.startswith(_UNKNOWN):
                        self._whole_at = 0.0  # what names its node is still on its way
                        continue
                    gid = bytes(info.endpoint_gid).hex()
                    owner = info.node_namespace.rstrip("/") + "/" + info.node_name
                    found[gid] = {
                        "gid": gid,
                        "kind": kind,
                        "node": owner,
                        "name": name,
                        "type": info.topic_type,
                        "hash": str(getattr(info, "topic_type_hash", "") or ""),
                        "qos": _told_qos(info.qos_profile),
                    }
        for owner, _, _, services in by_node:
            for name, types in services:
                for kind_of in types:
                    key = "%s %s %s" % (owner, name, kind_of)
                    found[key] = {
                        "gid": key,
                        "kind": "SS",
                        "node": owner,
                        "name": name,
                        "type": kind_of,
                        "hash": _service_hash(kind_of),
                        "qos": {},
                    }
        added = [each for key, each in found.items() if key not in self._known]
        removed = [key for key in self._known if key not in found]
        self._known = found
        shown = [owner for owner, _, _, _ in by_node]
        if added or removed or shown != self._nodes:
            self._nodes = shown
            self._link.say("G", 0, nodes=shown, added=added, removed=removed)


def _row(pair: tuple[str, list[str]]) -> tuple[str, tuple[str, ...]]:
    return pair[0], tuple(pair[1])


def _told_qos(profile: Any) -> dict[str, Any]:
    told: dict[str, Any] = {}
    for name, words in _POLICIES.items():
        word = words.get(int(getattr(profile, name)))
        if word is not None:
            told[name] = word
    if profile.depth:
        told["depth"] = profile.depth
    for name, field in (("deadline", "deadline"), ("lifespan", "lifespan"), ("lease", "liveliness_lease_duration")):
        value = getattr(profile, field).nanoseconds
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


if __name__ == "__main__":
    sys.exit(main())
