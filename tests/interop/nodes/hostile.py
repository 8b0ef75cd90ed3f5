"""Send hostile bytes to ports of this network namespace; any Python, no ROS.

hostile.py HOST SECONDS tcp:PORT… udp:PORT… — one pass over all attacks at least, then again until the time is over.
Event: ``done`` with the number of attacks.
"""

import contextlib
import json
import random
import socket
import struct
import sys
import time
from collections.abc import Iterator

_BOMB = (
    b'<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "' + b"A" * 50 + b'">'
    + b"".join(b'<!ENTITY %c "%s">' % (98 + i, b"&%c;" % (97 + i) * 10) for i in range(10))
    + b"]><methodCall><methodName>&k;</methodName></methodCall>"
)  # fmt: skip


def _post(body: bytes, length: int | None = None) -> bytes:
    return (
        b"POST /RPC2 HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % (len(body) if length is None else length)
        + body
    )


def attacks(rng: random.Random) -> Iterator[bytes]:
    """Bytes that some parser on some port might stumble over."""
    yield b""
    yield rng.randbytes(1)
    yield rng.randbytes(24)
    yield rng.randbytes(1000)
    yield rng.randbytes(200_000)
    yield b"\x00" * 100_000
    yield b"\xff" * 100_000
    yield b"GET / HTTP/1.1\r\n\r\n"
    yield b"GET " + b"/" * 100_000
    yield b"POST / HTTP/1.1\r\n" + b"X: y\r\n" * 20_000
    yield _post(b"<methodCall/>")
    yield _post(b"<methodCall><methodName>getPid</methodName><params><param><value><array><data>" * 2000)
    yield _post(_BOMB)
    yield _post(b"", 10**12)
    yield _post(b"abc", -5)
    yield _post(b"\xff\xfe" * 500)
    yield b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nffffffffffff\r\n"
    yield struct.pack("<I", 0xFFFFFFFF) + b"x" * 100
    yield struct.pack("<I", 0)
    yield struct.pack("<II", 8, 0xFFFFFFFF) + b"topic=/x"
    yield struct.pack("<II", 12, 8) + b"noequals"
    fields = b"".join(struct.pack("<I", len(f)) + f for f in (b"topic=/chatter", b"md5sum=*", b"callerid=\xff\xfe"))
    yield struct.pack("<I", len(fields)) + fields
    for version in (0, 1, 2, 255):
        hello = b"RMPA" + struct.pack(">BBHQ", version, 1, 0, rng.getrandbits(64)) + rng.randbytes(16)
        rest = struct.pack(">IQI", 1000, 0, 0)
        yield struct.pack(">IBBHIIQ", len(hello) + len(rest) + 2, 1, 3, 0, 0, 0, 0) + hello + rest + b"\x01x"
        yield struct.pack(">IBBHIIQ", 0xFFFFFFFF, version, 3, 0, 0, 0, 0) + b"RMPA"
        for kind in (0, 1, 2, 3, 4, 9):
            beacon = b"RMPA" + struct.pack(">BBHQ", version, kind, 0, rng.getrandbits(64)) + rng.randbytes(16)
            yield beacon + struct.pack(">IIB", 1000, 1, rng.choice([0, 3, 64, 255])) + b"eve" + rng.randbytes(40)


def strike(kind: str, host: str, port: int, data: bytes, kept: list[socket.socket]) -> None:
    """One attack; some connections are left open and silent, as a slow attacker does."""
    with contextlib.suppress(OSError):
        if kind == "udp":
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
                sock.sendto(data[:60_000], (host, port))
            return
        sock = socket.create_connection((host, port), 2.0)
        sock.settimeout(0.05)
        kept.append(sock)
        for start in range(0, len(data), 7919):
            sock.sendall(data[start : start + 7919])
        sock.recv(1)
        if len(kept) > 40:
            kept.pop(0).close()


def main() -> None:
    host, seconds, *targets = sys.argv[1:]
    rng = random.Random(20)
    kept: list[socket.socket] = []
    count = 0
    end = time.monotonic() + float(seconds)
    while True:
        for data in attacks(rng):
            for target in targets:
                kind, port = target.split(":")
                strike(kind, host, int(port), data, kept)
                count += 1
        if time.monotonic() > end:
            break
    for sock in kept:
        sock.close()
    print("@ " + json.dumps({"event": "done", "attacks": count}), flush=True)


if __name__ == "__main__":
    main()
