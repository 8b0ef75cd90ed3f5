"""The peer of the pages' commands: publishes /joy, /camera/image and /tf, and offers /arm/enable, at a core."""

from __future__ import annotations

import asyncio
import sys

from rmpa.ros.node.node import Node

TOPICS = {"/joy": "sensor_msgs/Joy", "/camera/image": "sensor_msgs/Image", "/tf": "tf2_msgs/TFMessage"}


async def main(uri: str) -> None:
    """Publish ten times a second, until it is ended."""
    async with Node("stick", master_uri=uri) as node:
        await node.advertise_service(
            "/arm/enable", "std_srvs/SetBool", lambda asked: {"success": asked.data, "message": ""}
        )
        publishers = [await node.advertise(topic, kind) for topic, kind in TOPICS.items()]
        print("publishing", flush=True)
        while True:
            for publisher in publishers:
                publisher.publish()
            await asyncio.sleep(0.1)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
