"""Limits of the monitor's clients.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB

PATCH_PERIOD: Final = 0.15
"""Between two patches of one client: some 7 a second, which looks live and is read at leisure."""
STATE_PERIOD: Final = 0.15
"""Shortest time from one snapshot of the agent to the next while pages are open."""
STATE_SHARE: Final = 4.0
"""The pause between two snapshots is at least so many times as long as a snapshot takes: a fifth of a core."""
UNACKNOWLEDGED_MAX: Final = 2
"""States and patches that a client has not acknowledged yet. A slow browser gets fewer patches, never a queue."""
REQUEST_MAX: Final = 64 * KIB
"""Bytes of one message of a client: a parameter's value, or the arguments of a call."""
REQUEST_RATE: Final = 50.0
"""Messages of one client a second, in the long run: a joystick sends 10, acknowledgements 7."""
REQUEST_BURST: Final = 200.0
"""Messages of one client at once: a page that reconnects and asks for all that it shows."""
LOOKS_MAX: Final = 4
"""Things whose details one client is shown at one time; a page shows one or two."""
WATCHES_MAX: Final = 16
"""Topics whose messages one client is shown at one time."""
WATCH_RATE_MAX: Final = 10.0
"""Values, images and scans a second of one watch."""
FIELDS_MAX: Final = 8
"""Numeric fields of one plot: as many lines as can be told apart."""
FIELD_CHARACTERS: Final = 256
"""Characters of a field's path, as ``pose.pose.position.x``."""
ASKS_MAX: Final = 16
"""Questions of one client (why, calls, parameters) that wait for their answer."""
POINTS_MAX: Final = 64
"""Samples of a plot in one message. Of more, the least and the greatest of each part are kept."""
VALUE_CHARACTERS: Final = 512
"""Characters of a string in a live value; the rest is cut."""
VALUE_ITEMS: Final = 64
"""Elements of an array in a live value; the rest is counted."""
VALUE_NODES: Final = 2000
"""Values in one live value, all levels together."""
SCAN_POINTS: Final = 720
"""Ranges of a laser scan that are sent: two a degree. Of more, the nearest of each part is kept."""
IMAGE_PIXELS: Final = 320 * 240
"""Pixels of an uncompressed image that are sent; of more, every n-th row and column."""
TOPICS_SHOWN: Final = 2000
"""Topics in a state; further ones are counted."""
SERVICES_SHOWN: Final = 2000
"""Services in a state; further ones are counted."""
NODES_SHOWN: Final = 2000
"""Nodes in a state; further ones are counted."""
PARAMETER_NAMES_SHOWN: Final = 5000
"""Names of parameters that a search is given."""
MODULES_SHOWN: Final = 256
"""Modules in a state; further ones are counted. A ring of more could not be read."""
FLOW_TOPICS: Final = 8
"""Topics that a flow names; the busiest first."""
LOG_LINES: Final = 500
"""Lines of the log that are kept for a page that opens it."""
LOG_CHARACTERS: Final = 1024
"""Characters of one line of the log; the rest is cut."""
SILENT_AFTER: Final = 1.0
"""Time without a word on a link after which its module is shown as silent. Keepalives come more often. For a
link at rest it is half of its lease."""
AWAY_AFTER: Final = 7.0
"""Time without a beacon after which a module without a link is shown as away. Heartbeats come every 5 s."""
AGENT_SETTLES: Final = 10.0
"""Time after the start of this module's agent in which peers that it has not found yet do not count as lost: beacons
come every 5 s at the latest, and links take seconds where names or addresses are resolved."""
FORGET_AFTER: Final = 600.0
"""Time for which a module that has left the roster is still shown."""
STEADY: Final = 0.03
"""Share by which a figure must change before it is shown anew, so that noise moves nothing."""
RATE_SMOOTHING: Final = 1.0
"""Time constant of a link's byte rates."""
ORDER_AGE: Final = 5.0
"""Seconds that an order of a page may be old: less than the page waits for a word before it gives all up."""
DRIVE_TIMEOUT: Final = 0.3
"""Time after the last command of a joystick after which the robot is stopped; a joystick sends every 0.1 s."""
DRIVE_SPEED: Final = 2.0
"""Magnitude of a linear speed that a joystick may command, m/s."""
DRIVE_TURN: Final = 4.0
"""Magnitude of an angular speed that a joystick may command, rad/s."""
RESOURCES_MAX: Final = 256
"""Paths of Smart Resources that are followed; each is up to nine subscriptions."""
LOOK_KEPT: Final = 10.0
"""Time for which the details of a Smart Resource are followed after a page has shown it."""
TICK_PERIOD: Final = 2.0
"""Time between two signs of life to a page, which takes its connection for lost after three without any."""
UNSENT_RETRY: Final = 0.1
"""Pause before it is looked again whether a page has taken what was sent."""
ANSWERS_AT_ONCE: Final = 4
"""Questions of all pages together that wait for the agent, each in a thread: `why` takes seconds."""
VALUES_BYTES: Final = 4 * MIB
"""Bytes of the messages whose decoded values are kept for further pages; values take some ten times as much."""
DECISION_DEPTH: Final = 32
"""Objects and arrays within each other in what a Smart Resource says of its decision; a deeper one is not shown."""
STATE_PAUSE_MAX: Final = 0.5
"""The longest pause between two snapshots."""
