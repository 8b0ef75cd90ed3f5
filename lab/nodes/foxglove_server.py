"""foxglove-sdk's server, fed by our own client: each message of one ROS topic becomes one of a channel, undecoded.

Options: --topic, --port, --name. Events: up with the port.
"""

from __future__ import annotations

import asyncio
import os
import signal
from typing import TYPE_CHECKING, Final

import foxglove
from foxglove import Channel, Schema

from node import parser, say
from rmpa.ros.node.node import Node
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from rmpa.ros.node.endpoints import Received

KIND: Final = "std_msgs/UInt8MultiArray"


async def main() -> None:
    """Run until a signal or the master ends us."""
    options = parser(__doc__)
    options.add_argument("--topic", default="/image")
    options.add_argument("--port", type=int, default=0)
    given = options.parse_args()
    schema = Schema(name=KIND, encoding="ros1msg", data=MessageType(KIND).definition.encode())
    channel = Channel(given.topic, message_encoding="ros1", schema=schema)
    server = foxglove.start_server(port=given.port, name="foxglove-sdk")
    ended = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)

    def received(message: Received) -> None:
        # The SDK takes bytes alone.
        channel.log(bytes(message.raw), log_time=message.stamp_ns)

    async with Node(given.name or f"foxglove_{os.getpid()}", on_shutdown=lambda _: ended.set()) as node:
        await node.subscribe(given.topic, None, received)
        say("up", port=server.port)
        await ended.wait()
    server.stop()


if __name__ == "__main__":
    asyncio.run(main())
