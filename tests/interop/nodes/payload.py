"""What the talkers send and the listeners check; ``payload.hpp`` is the same in C++.

A payload has a header of 20 bytes, little-endian: source (4), sequence from 1 (4), sender's wall clock in ns (8),
CRC-32 of the body (4); then the body: bytes of a fixed pattern that starts elsewhere for each message.
"""

import argparse
import struct
import time
import zlib
from typing import Any

import node
from node import say

__all__ = ["HEADER", "Pattern", "Tally", "of_another_release", "parser", "say"]

HEADER = struct.Struct("<IIQI")
_PERIOD = 251


class Pattern:
    """Bodies of one size.

    Args:
        size: Bytes of a whole payload; at least the header's.
    """

    def __init__(self, size: int) -> None:
        self.size = max(size, HEADER.size)
        length = self.size - HEADER.size + _PERIOD
        # i * i + (i >> 8) in one byte begins anew after 64 KiB.
        run = bytes((i * i + (i >> 8)) & 0xFF for i in range(min(length, 1 << 16)))
        self._bytes = (run * (length // len(run) + 1))[:length]

    def payload(self, source: int, sequence: int) -> bytes:
        """The payload of one message."""
        start = sequence % _PERIOD
        body = self._bytes[start : start + self.size - HEADER.size]
        return HEADER.pack(source, sequence, time.time_ns(), zlib.crc32(body)) + body


class Tally:
    """What a listener has received, checked against what the senders must have sent."""

    def __init__(self) -> None:
        self.count = 0
        self.bad = 0
        self.size = 0
        self.sources: dict[int, dict[str, int]] = {}

    def take(self, data: bytes) -> None:
        """Check one payload and count it."""
        self.count += 1
        self.size += len(data)
        if len(data) < HEADER.size:
            self.bad += 1
            return
        source, sequence, _, crc = HEADER.unpack_from(data)
        if zlib.crc32(memoryview(data)[HEADER.size :]) != crc:
            self.bad += 1
            return
        if source not in self.sources:
            self.sources[source] = {"count": 1, "first": sequence, "last": sequence, "gaps": 0, "doubled": 0}
            return
        seen = self.sources[source]
        seen["count"] += 1
        if sequence == seen["last"] + 1:
            seen["last"] = sequence
        elif sequence > seen["last"]:
            seen["gaps"] += sequence - seen["last"] - 1
            seen["last"] = sequence
        else:
            seen["doubled"] += 1

    def report(self) -> dict[str, object]:
        """The totals; sources are keyed by their number as text, as JSON has it."""
        rows = self.sources.values()
        return {
            "count": self.count,
            "bytes": self.size,
            "bad": self.bad,
            "gaps": sum(row["gaps"] for row in rows),
            "doubled": sum(row["doubled"] for row in rows),
            "last": max((row["last"] for row in rows), default=0),
            "sources": {str(key): row for key, row in self.sources.items()},
        }


def of_another_release(kind: Any) -> type:
    """A message class as a package of another release has it: the same name, another definition and md5 sum."""
    fields = {"_md5sum": "f" * 32, "_full_text": kind._full_text + "\nfloat32 quality\n"}
    return type(kind.__name__, (kind,), fields)


def parser(description: str) -> argparse.ArgumentParser:
    """The options that every node of ours has."""
    made: argparse.ArgumentParser = node.parser(description)
    made.add_argument("--topic", default="/chatter")
    return made
