"""foxglove-sdk's server, fed by our own client: each message of one ROS topic becomes one of a channel, undecoded.

Options: --topic, --port, --name. Events: up with the port.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import foxglove
from foxglove import Channel, Schema

from node import parser, say
from own_ends import KIND, run
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    import asyncio

    from rmpa.ros.node.endpoints import Received
    from rmpa.ros.node.node import Node


def main() -> None:
    """Run until a signal ends us."""
    options = parser(__doc__)
    options.add_argument("--topic", default="/image")
    options.add_argument("--port", type=int, default=0)
    given = options.parse_args()
    schema = Schema(name=KIND, encoding="ros1msg", data=MessageType(KIND).definition.encode())
    channel = Channel(given.topic, message_encoding="ros1", schema=schema)
    server = foxglove.start_server(port=given.port, name="foxglove-sdk")

    async def body(node: Node, ended: asyncio.Event) -> None:
        def received(message: Received) -> None:
            # The SDK takes bytes alone.
            channel.log(bytes(message.raw), log_time=message.stamp_ns)

        await node.subscribe(given.topic, None, received)
        say("up", port=server.port)
        await ended.wait()

    run(given.name or f"foxglove_{os.getpid()}", body)
    server.stop()


if __name__ == "__main__":
    main()
