"""The bridge, driven by asyncio."""
