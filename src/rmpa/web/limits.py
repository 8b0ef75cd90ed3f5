"""Limits of the web server's clients.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.sizes import KIB, MIB

# --- Foxglove WebSocket -----------------------------------------------------------------------------------------
FOXGLOVE_TEXT_MAX: Final = 1 * MIB
"""Bytes of one JSON message of a client; the longest name the parameters that it wants."""
FOXGLOVE_BINARY_MAX: Final = 64 * MIB
"""Bytes of one binary message of a client: an image or a map that it publishes."""
FOXGLOVE_SUBSCRIPTIONS_MAX: Final = 4096
"""Subscriptions of one client; each has a queue of its own."""
FOXGLOVE_ADVERTISED_MAX: Final = 256
"""Topics that one client publishes at one time; each is a publisher in the graph."""
FOXGLOVE_CALLS_MAX: Final = 256
"""Service calls of one client that wait for their response."""
FOXGLOVE_PARAMETERS_MAX: Final = 4096
"""Parameters in one message of a client, and parameters that it follows by name."""
FOXGLOVE_PARAMETER_REQUESTS_MAX: Final = 64
"""Requests for parameters of one client that wait for their answer."""
FOXGLOVE_PARAMETER_DEPTH_MAX: Final = 32
"""Lists and maps within each other in a parameter's value, as XML-RPC values are bounded."""
FOXGLOVE_ASSETS_MAX: Final = 16
"""Assets that one client waits for at one time."""
FOXGLOVE_ASSET_MAX: Final = 64 * MIB
"""Bytes of one asset: the mesh of a large robot has some 20 MB."""
FOXGLOVE_NAME_MAX: Final = 1024
"""Characters of a name, a type, an encoding or an asset's URI in a message of a client."""
FOXGLOVE_ADVERTISE_BYTES: Final = 256 * KIB
"""Characters of schemas in one advertise message; further channels go into further messages."""
FOXGLOVE_STATUS_RATE: Final = 5.0
"""Status messages a second for errors of one client, in the long run."""
FOXGLOVE_STATUS_BURST: Final = 100.0
"""Errors of one client at once. Beyond that and the rate, what it may not do is refused without a status, and a
malformed message disconnects it: it does not speak the protocol."""

# --- /metrics -----------------------------------------------------------------------------------------------------
METRIC_PEERS: Final = 512
"""Peers in /metrics, each with some fifteen time series: as many as an agent may know."""
METRIC_ROUTES: Final = 2000
"""Routes in /metrics, each with some twenty time series; a module of 300 topics and three peers has some 1,000."""
METRIC_SERVICES: Final = 1000
"""Services in /metrics, each with some six time series."""
METRIC_REASONS: Final = 256
"""Counters of what was refused or dropped in /metrics; there are some hundred."""
METRIC_LABEL_CHARACTERS: Final = 256
"""Characters of a label's value in /metrics, which Prometheus keeps with each time series."""

# --- REST ---------------------------------------------------------------------------------------------------------
REST_PATH_MAX: Final = 2048
"""Characters of a path: a name of 512 characters, percent-encoded."""
REST_NAMES_COMPARED: Final = 1000
"""Names that a wrong one is compared with for a hint, which takes some microseconds each."""
