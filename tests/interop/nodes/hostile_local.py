"""Attack an agent from its own machine: control socket, XML-RPC, TCPROS; any Python, no ROS.

hostile_local.py SECONDS CONTROL_SOCKET tcp:PORT… — Event: ``done``.
"""

import contextlib
import json
import socket
import struct
import sys
import time


def control(path: str) -> int:
    """Garbage, a huge line, 100 clients that stay."""
    for data in (b"\xff" * 1000 + b"\n", b"{}\n", b"[" * 100_000 + b"\n", b'{"op": 7}\n', b"x" * 3_000_000):
        with socket.socket(socket.AF_UNIX) as sock, contextlib.suppress(OSError):
            sock.settimeout(5.0)
            sock.connect(path)
            sock.sendall(data)
            sock.recv(1 << 16)
    kept = []
    for _ in range(100):
        sock = socket.socket(socket.AF_UNIX)
        sock.connect(path)
        kept.append(sock)
    refused = 0
    for sock in kept:
        with contextlib.suppress(OSError):
            sock.settimeout(0.05)
            refused += b"too many" in sock.recv(1000)
        sock.close()
    return refused


def main() -> None:
    seconds, path, *targets = sys.argv[1:]
    end = time.monotonic() + float(seconds)
    ports = [int(target.partition(":")[2]) for target in targets]
    huge = b"POST /RPC2 HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000000000\r\n\r\n" + b"x" * 100_000
    gigabyte = struct.pack("<I", 1_000_000_000) + struct.pack("<I", 999_999_000) + b"topic=" + b"/" * 100_000
    slow = []
    for port in ports:
        for data in (huge, gigabyte):
            for _ in range(10):
                with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 2.0) as sock:
                    sock.settimeout(0.1)
                    sock.sendall(data)
                    sock.recv(1000)
        for _ in range(60):
            with contextlib.suppress(OSError):
                sock = socket.create_connection(("127.0.0.1", port), 2.0)
                slow.append(sock)
    refused = control(path)
    request = b"POST /RPC2 HTTP/1.1\r\nHost: x\r\nX-Slow: "
    at = 0
    while time.monotonic() < end:
        for sock in slow:
            with contextlib.suppress(OSError):
                sock.sendall(request[at : at + 1] or b"y")
        at += 1
        time.sleep(0.1)
    for sock in slow:
        sock.close()
    print("@ " + json.dumps({"event": "done", "refused": refused, "slow": len(slow)}), flush=True)


if __name__ == "__main__":
    main()
