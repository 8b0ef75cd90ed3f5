"""The velocity node of the paper's robot (our own client): each command leaves as a velocity, its head kept.

``--mode event``: at once; ``--mode polled``: at ``--rate`` Hz the newest command, if there is a new one.
Events: ``up``; ``connected`` with the number of subscribers of the velocity.
"""

from __future__ import annotations

import asyncio
import os
import threading
from typing import TYPE_CHECKING

from node import Newest, say, serve_polls, velocity_options
from own_ends import KIND, run, watch

if TYPE_CHECKING:
    from rmpa.ros.node.node import Node, Received


def main() -> None:
    """Run until a signal ends us."""
    args = velocity_options(__doc__).parse_args()

    async def body(node: Node, ended: asyncio.Event) -> None:
        loop = asyncio.get_running_loop()
        publisher = await node.advertise(args.vel, KIND, queue_messages=args.queue)
        newest: Newest[bytes] = Newest()

        def take(received: Received) -> None:
            if args.mode == "event":
                publisher.publish_raw(received.raw)
            else:
                newest.put(received.raw)

        def poll() -> None:
            message = newest.take()
            if message is not None:
                loop.call_soon_threadsafe(publisher.publish_raw, message)

        await node.subscribe(args.cmd, KIND, take, nodelay=args.nodelay)
        if args.mode == "polled":
            polling = (args.rate, poll, lambda: not ended.is_set())
            threading.Thread(target=serve_polls, args=polling, daemon=True).start()
        watching = asyncio.create_task(watch(publisher))
        say("up")
        await ended.wait()
        watching.cancel()

    run(args.name or f"velocity_{os.getpid()}", body)


if __name__ == "__main__":
    main()
