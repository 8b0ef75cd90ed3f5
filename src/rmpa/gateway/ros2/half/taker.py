"""Takes serialized messages with the GID of their publisher, whichever release of rclpy is there."""

from __future__ import annotations

import ctypes
import os
import time
from typing import Any

# Bytes of a GUID of DDS that its participant has (DDSI-RTPS 9.3.1).
_PARTICIPANT = 12
# Bytes from which on a message is not copied.
_LARGE = 65536
# The fields of rcutils_allocator_t, pointers all.
_ALLOCATOR = ("allocate", "deallocate", "reallocate", "zero_allocate", "state")


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


class _Allocator(ctypes.Structure):
    """rcutils_allocator_t."""

    _fields_ = [(name, ctypes.c_void_p) for name in _ALLOCATOR]


class Taker:
    """Takes them one by one.

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
        # The arguments of a take behind the subscription, and where it leaves the GID.
        self._into: tuple[int, int, None] = (0, 0, None)
        self._gid_at = self._gid_size = 0

    def check(self, node: Any, message_type: Any, qos: Any, handle_of: Any) -> None:
        """Publish to ourselves, and see which way gives the publisher's GID."""
        name = "/rmpa/_gid_check_%d" % os.getpid()
        subscription = node.create_subscription(message_type, name, ignore, qos, raw=True)
        publisher = node.create_publisher(message_type, name, qos)
        handle = handle_of(subscription)
        try:
            own = self._own_gid(node, name)
            for layout in (None, (16, True), (24, True), (24, False)):
                if layout is not None and not self._use(layout):
                    return
                for _ in range(20):
                    publisher.publish(b"\0\1\0\0\0\0\0\0")
                    time.sleep(0.02)
                    taken = self.take(handle, message_type)
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
            rcl = ctypes.CDLL(loaded("librcl.so"))
            self._rcl = rcl.rcl_take_serialized_message
        except (OSError, AttributeError):
            return False
        self._rcl.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        kind = _message_info(*layout)
        self._info = kind()
        self._gid_at, self._gid_size = ctypes.addressof(self._info) + kind.gid.offset, layout[0]
        utils = ctypes.CDLL(loaded("librcutils.so"))
        utils.rcutils_get_default_allocator.restype = _Allocator
        allocator = utils.rcutils_get_default_allocator()
        self._array = _ByteArray()
        for field in _ALLOCATOR:
            setattr(self._array, field, getattr(allocator, field))
        self._into = ctypes.addressof(self._array), ctypes.addressof(self._info), None
        return True

    def take(self, handle: Any, message_type: Any) -> tuple[Any, bytes, int, int] | None:
        """The next message of a subscription with GID, source stamp (ns) and number; ``None``: there is none.

        The bytes of a large one hold until the next is taken.
        """
        if self._info is None:
            taken = handle.take_message(message_type, True)
            if taken is None:
                return None
            data, info = taken
            gid = info.get("publisher_gid") if isinstance(info, dict) else None
            number = info.get("publication_sequence_number") if isinstance(info, dict) else 0
            stamp = info["source_timestamp"] if isinstance(info, dict) else 0
            return data, _gid_bytes(gid), stamp, number or 0
        if self._rcl(handle.pointer, *self._into):
            return None
        info = self._info
        array, data = self._array, None
        if array.length < _LARGE:
            data = ctypes.string_at(array.buffer, array.length)
        else:
            data = (ctypes.c_uint8 * array.length).from_address(ctypes.addressof(array.buffer.contents))
        return data, ctypes.string_at(self._gid_at, self._gid_size), info.source_stamp, getattr(info, "sequence", 0)

    def is_own(self, gid: bytes) -> bool:
        """Whether a message is of a publisher of this process."""
        return self.gids and gid[:_PARTICIPANT] == self.prefix


def _gid_bytes(gid: Any) -> bytes:
    if gid is None:
        return b""
    return bytes(gid["data"] if isinstance(gid, dict) else gid)


def loaded(name: str) -> str:
    """The path of a library that this process has loaded: in wheels its name has a hash behind."""
    stem = name.split(".", maxsplit=1)[0]
    with open("/proc/self/maps") as maps:
        for line in maps:
            path = line.split(None, 5)[5].strip() if line.count("/") else ""
            base = os.path.basename(path)
            if base.startswith((stem + ".", stem + "-")):
                return path
    return name


def ignore(_message: Any) -> None:
    """Do nothing: the callback of what is taken by hand."""
