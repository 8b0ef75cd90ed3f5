"""Dialling, accepting and driving links with asyncio."""
