"""Every bound of the neighbour zenoh-bridge-ros1, with unit and reason."""

from __future__ import annotations

from typing import Final

PRESENCE_LEASE: Final = 3.5
"""Seconds without a put of presence after which what it announced is gone: the bridge itself waits for three periods
of one second, and takes turns with others that announce the same."""
REMOTE_MAX: Final = 10_000
"""Topics and services of bridges that are remembered; more are ignored, and counted. A robot has some hundred."""
TYPE_TIMEOUT: Final = 10.0
"""Seconds for the question to a local server for the type of its service, and between two such questions."""
CALLS_MAX: Final = 200
"""Calls of bridges to services of this site that run at one time; more are refused with an error."""
