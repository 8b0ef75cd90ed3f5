"""Note when each measured message comes (our own client); see ``node.Notes``.

Events: ``up``; ``noted`` with the round and the count; ``first`` with the topic when its first message came;
``again`` with the gap when the first after a pause did.
"""

from __future__ import annotations

import os
import threading
from functools import partial
from typing import TYPE_CHECKING

from node import Notes, say, sink_options
from own_ends import DATA, KIND, run

if TYPE_CHECKING:
    import asyncio

    from rmpa.ros.node.node import Node, Received


def main() -> None:
    """Run until a signal ends us."""
    args = sink_options(__doc__).parse_args()
    notes = Notes(args.topics)

    def take(topic: int, received: Received) -> None:
        notes.note(topic, received.raw, DATA)

    async def body(node: Node, ended: asyncio.Event) -> None:
        for index, topic in enumerate(args.topics):
            await node.subscribe(topic, KIND, partial(take, index), nodelay=args.nodelay)
        threading.Thread(target=notes.serve, daemon=True).start()
        say("up")
        await ended.wait()

    run(args.name or f"sink_{os.getpid()}", body)


if __name__ == "__main__":
    main()
