"""Offers the service /add_two_ints, until Ctrl-C."""

import asyncio
from typing import Any

import rmpa


async def main() -> None:
    """Serve until Ctrl-C."""
    async with rmpa.Node("add_two_ints_server", handle_signals=True) as node:

        def add(request: Any) -> dict[str, int]:
            node.logger.info("%d + %d", request.a, request.b)
            return {"sum": request.a + request.b}

        await node.advertise_service("/add_two_ints", "rospy_tutorials/AddTwoInts", add)
        await node.stopped.wait()


asyncio.run(main())
