"""Publish rounds of measured messages on an absolute schedule (our own client); see ``node.serve_rounds``.

Events: ``up``; ``connected`` with the number of subscribers; ``sent`` with the round, the count, and when the first
was due.
"""

from __future__ import annotations

import asyncio
import os
import threading
from typing import TYPE_CHECKING

from node import say, serve_rounds, source_options
from own_ends import KIND, framed, run, watch

if TYPE_CHECKING:
    from rmpa.ros.node.node import Node


def main() -> None:
    """Run until a signal ends us."""
    args = source_options(__doc__).parse_args()

    async def body(node: Node, ended: asyncio.Event) -> None:
        publisher = await node.advertise(args.topic, KIND, queue_messages=args.queue)
        loop = asyncio.get_running_loop()

        def publish(data: bytearray) -> None:
            loop.call_soon_threadsafe(publisher.publish_raw, framed(data))

        # Timers of the loop are late by a millisecond; a thread's sleep is not.
        threading.Thread(
            target=serve_rounds, args=(publish, args.phase, lambda: not ended.is_set()), daemon=True
        ).start()
        watching = asyncio.create_task(watch(publisher))
        say("up")
        await ended.wait()
        watching.cancel()

    run(args.name or f"source_{os.getpid()}", body)


if __name__ == "__main__":
    main()
