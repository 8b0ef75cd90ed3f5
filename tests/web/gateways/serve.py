"""Both gateways with a core of their own, for clients that are programs: ``python -m tests.web.gateways.serve PORT``.

It prints its port (0: any), and ends when its standard input does.
"""

from __future__ import annotations

import asyncio
import sys

from tests.web.gateways.server import running_server
from tests.web.hub.client import local_core


async def main(port: int) -> None:
    async with local_core() as core, running_server(core, port=port) as server:
        print(server.port, flush=True)
        await asyncio.to_thread(sys.stdin.read)


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1])))
