"""Shows which modules and topics come and go, until Ctrl-C."""

import asyncio
import contextlib

from rmpa.client import AgentClient, PeerLinked, PeerLost, TopicAppeared, TopicGone


async def main() -> None:
    """Show what is there, then each change."""
    async with AgentClient() as agent:
        async for event in agent.events():
            match event:
                case PeerLinked():
                    print(f"+ module {event.peer.name}", flush=True)
                case PeerLost():
                    print(f"- module {event.peer.name} {event.peer.last_error}", flush=True)
                case TopicAppeared():
                    print(f"+ topic {event.topic.name} {event.topic.type}", flush=True)
                case TopicGone():
                    print(f"- topic {event.topic.name}", flush=True)


with contextlib.suppress(KeyboardInterrupt):
    asyncio.run(main())
