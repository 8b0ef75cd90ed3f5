"""The floor in Python: raw blocking TCP ping-pong over loopback; arguments and lines as of ``floor.cpp``."""

import array
import socket
import struct
import sys
import time
from pathlib import Path

from node import say


def read_all(sock: socket.socket, view: memoryview) -> bool:
    done = 0
    while done < len(view):
        got = sock.recv_into(view[done:])
        if not got:
            return False
        done += got
    return True


def serve() -> None:
    listener = socket.create_server(("127.0.0.1", 0))
    say("up", port=listener.getsockname()[1])
    sock, _ = listener.accept()
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    view = memoryview(bytearray(4 + (1 << 21)))
    while read_all(sock, view[:4]):
        end = 4 + int(struct.unpack_from("<I", view)[0])
        if not read_all(sock, view[4:end]):
            break
        sock.sendall(view[:end])


def ping(port: int) -> None:
    sock = socket.create_connection(("127.0.0.1", port))
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    view = memoryview(bytearray(4 + (1 << 21)))
    say("ready")
    for line in sys.stdin:
        size, count, path = line.split()
        end = 4 + int(size)
        struct.pack_into("<I", view, 0, int(size))
        samples = array.array("Q")
        for _ in range(int(count)):
            start = time.perf_counter_ns()
            sock.sendall(view[:end])
            read_all(sock, view[:end])
            samples.append(time.perf_counter_ns() - start)
        Path(path).write_bytes(samples.tobytes())
        say("round", lost=0)


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve()
    else:
        ping(int(sys.argv[2]))
