"""asyncio, sockets and the system clock for the rooms above."""
