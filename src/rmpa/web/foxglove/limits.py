"""Bounds and time-outs of one client of Foxglove's protocol; in seconds and bytes unless stated otherwise."""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB

# [Foxglove] Bytes of a JSON message
# At it: it is refused
# Told in: status
# Why: The longest name the parameters that a client wants.
TEXT_MAX: Final = 1 * MIB
# [Foxglove] Bytes of a binary message: one that is published, or a call
# At it: it is refused
# Told in: status
# Why: An image or a map that a client publishes.
BINARY_MAX: Final = 64 * MIB
# [Foxglove] Subscriptions
# At it: further ones are refused
# Told in: status
# Why: Each has a queue of its own.
SUBSCRIPTIONS_MAX: Final = 4096
# [Foxglove] Topics that it publishes
# At it: further ones are refused
# Told in: status
# Why: Each is a publisher in the graph.
ADVERTISED_MAX: Final = 256
# [Foxglove] Service calls under way
# At it: further ones fail
# Told in: the call's failure
CALLS_MAX: Final = 256
# [Foxglove] Parameters that one message names, or that are followed by name
# At it: the message is refused; all can be asked for at once
# Told in: status
PARAMETERS_MAX: Final = 4096
# [Foxglove] Requests for parameters under way
# At it: further ones are refused
# Told in: status
PARAMETER_REQUESTS_MAX: Final = 64
# [Foxglove] Lists and maps within each other in a parameter
# At it: it is refused
# Told in: status
# Why: As XML-RPC values are bounded.
PARAMETER_DEPTH_MAX: Final = 32
# [Foxglove] Assets that are being fetched
# At it: further ones are refused
# Told in: the asset's failure
ASSETS_MAX: Final = 16
# [Foxglove] Bytes of an asset
# At it: it is refused
# Told in: the asset's failure
# Why: The mesh of a large robot has some 20 MB.
ASSET_MAX: Final = 64 * MIB
# [Foxglove] Characters of a name, type, encoding or asset's URI
# At it: the message is refused
# Told in: status
NAME_MAX: Final = 1024
# Characters of schemas in one advertise message; further channels go into further messages.
ADVERTISE_BYTES: Final = 256 * KIB
# Status messages a second for errors of one client, in the long run.
STATUS_RATE: Final = 5.0
# [Foxglove] Errors at once
# At it: further ones are reported five times a second; a malformed message ends the connection
# Told in: the close reason
# Why: Beyond that and the rate, what a client may not do is refused without a status: it does not speak the protocol.
STATUS_BURST: Final = 100.0
