"""Asks the sonar for more than it gives, from any ROS core of the mesh: python ask.py http://127.0.0.1:11311."""

import asyncio
import sys

from rmpa.resource import Node, ResourceClient, at_most


async def main(master_uri: str) -> None:
    """Ask, and wait until it is given."""
    async with Node("guest", master_uri=master_uri) as node, ResourceClient(node, "sonar") as sonar:
        await sonar.require(accuracy=at_most("2 cm", hard=True))
        async for answer in sonar.answers():
            if answer.message == "profile exact":
                print(answer.level.name, answer.message, dict(answer.values))
                return


asyncio.run(main(sys.argv[1]))
