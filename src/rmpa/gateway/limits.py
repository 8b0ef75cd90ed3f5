"""Every bound of the gateway, with unit and reason."""

from __future__ import annotations

from typing import Final

from rmpa.core.sizes import KIB, MIB

KEY_MAX: Final = 2048
"""Characters of a key expression or a liveliness token that another site or a ROS 2 node sent. Longer ones are not
read; the longest that ROS names and types make is some 900."""
GID_MAX: Final = 255
"""Bytes of the source's GID in an attachment of ROS 2: its length is one byte."""
QOS_NUMBER_MAX: Final = 2**63 - 1
"""The largest number in a QoS of ROS 2: they are 64-bit there."""
ENTITY_ID_MAX: Final = 2**64 - 1
"""The largest number of a node or an endpoint in a liveliness token."""
DOMAIN_MAX: Final = 2**32 - 1
"""The largest ROS domain id in a key; ROS 2 uses 0 to 232."""
PATH_MAX: Final = 8
"""Sites that a message passes at most; more mean a loop."""
SERVICE_DESCRIPTION_MAX: Final = 8192
"""Bytes of the description of another site's service: four names."""
SITE_CALLS_AT_ONCE: Final = 32
"""Calls of other sites that one service gets at once, as many as an agent opens connections to a server for."""
SITE_CALLS_WAITING: Final = 1024
"""Calls of other sites that may wait for one service; further ones are refused at once."""
SITE_CALL_BYTES: Final = 256 * MIB
"""Bytes of the requests of other sites that are under way here: four of the largest."""
SITE_CALL_GRACE: Final = 1.0
"""Seconds that the calling site waits longer than the serving one, whose error text tells more."""
DESCRIBE_TIMEOUT: Final = 10.0
"""Seconds for the description of another site's service; its server may be probed for it over two meshes."""
LAST_VALUE_MAX: Final = 32 * MIB
"""Bytes of a message that is kept as a last value: a map of 5,000 by 5,000 cells. Larger ones are not kept."""
LAST_VALUES_MAX: Final = 4096
"""Last values that are kept; the oldest go first. A module has some 20 latched topics."""
LAST_VALUES_BYTES_MAX: Final = 256 * MIB
"""Bytes of all last values in the file; the oldest go first."""
LAST_VALUES_PENDING_MAX: Final = 64 * MIB
"""Bytes of last values that wait while the disk takes none; above it the oldest are not written."""
LAST_VALUES_INTERVAL: Final = 0.5
"""Seconds between writes: a topic that publishes quickly is written once in each."""
LAST_VALUES_OPEN_TIMEOUT: Final = 5.0
"""Seconds for the file of last values to open; a disk that hangs must not stop the gateway."""
LAST_VALUES_CLOSE_TIMEOUT: Final = 3.0
"""Seconds for the last write; a disk that hangs must not keep the gateway from ending."""
LAST_VALUES_READ_TIMEOUT: Final = 4.0
"""Seconds for one query of last values: less than the session waits for its answer."""
LAST_VALUES_ANSWER_MAX: Final = 64 * MIB
"""Bytes of all answers to one query of last values; the newest are given first."""
LATCH_LOOK_AFTER: Final = 5.0
"""Seconds that a topic is there before the gateway asks its publisher whether it is latched."""
LATCH_LOOK_TIMEOUT: Final = 10.0
"""Seconds for the publisher's answer to that."""
LATCH_LOOKS_AT_ONCE: Final = 2
"""Publishers that are asked that at once: each opens a route in the mesh for a moment."""
VALUE_HEADER_MAX: Final = 1 * MIB
"""Bytes of the header of another site's last value: most of it is the definition of its type."""
SITES_REMEMBERED_MAX: Final = 256
"""Sites that are remembered as unreachable; those that left first are forgotten first."""
SITE_REPORT_SOURCES_MAX: Final = 5000
"""Topics and services of one site in ``rmpa site info``: some 2 MB of JSON."""
VALUE_PORTION: Final = 256 * KIB
"""Bytes of a last value in one message to a module that asks for it: 20 ms on a 100 Mbit/s link."""
VALUE_READING_IDLE: Final = 60.0
"""Seconds for which a last value that is read in portions is kept without another question for it."""
SITE_ASK_TIMEOUT: Final = 5.0
"""Seconds for a question to another site's gateway."""
SITE_PARAMS_AT_ONCE: Final = 256
"""Questions of other sites about parameters that are answered at once, and parameters of other sites that modules
here may follow."""
SITE_PARAM_BYTES_MAX: Final = 64 * MIB
"""Bytes of one question or answer about parameters between gateways: some of the largest values."""
SITE_PARAM_TRANSFERS_MAX: Final = 64
"""Modules of other sites whose parameters are read or written in portions at once."""
SITE_FOLLOW_INTERVAL: Final = 1.0
"""Seconds between questions for followed parameters of other sites: one question for each module."""
SITE_PARAM_TIMEOUT: Final = 20.0
"""Seconds for a question about a parameter to another site: less than the module that asks waits for this gateway."""
LAST_VALUES_RETRY_MAX: Final = 30.0
"""Seconds between attempts to write to a disk that takes nothing."""
SITE_NAME_MAX: Final = 63
"""Characters of a site's name, as for a module's name and for a label of DNS."""
NODE_NAME_MAX: Final = 255
"""Bytes of a node's name in an attachment."""
ROS2_NAME_MAX: Final = 255
"""Characters of a node, topic or service of ROS 2; its own limit is about that for topics."""
ROS2_NODES_MAX: Final = 2000
"""Nodes of ROS 2 that are shown; any program that reaches the router can declare more."""
ROS2_ENDPOINTS_MAX: Final = 20000
"""Publishers, subscriptions, services and clients of ROS 2 that are looked at; each costs some 3 KB."""
ROS2_PROBLEMS_MAX: Final = 500
"""Problems of the neighbour ROS 2 that are kept for ``rmpa site``; the oldest go first."""
ROS2_CALL_TIMEOUT: Final = 600.0
"""Seconds of one call of a service between the mesh and ROS 2. Clients of ROS 1 and of rmw_zenoh wait without end; a
server that dies ends its calls at once."""
ROS2_CALLS_MAX: Final = 64
"""Calls of one service that are under way at one time, each way; the next one gets an error."""
ROS2_DESCRIBE_AGAIN: Final = (0.5, 30.0)
"""Seconds until a service that could not be asked for its type is asked again: at first, and at most; it doubles."""
OPEN_RETRY_FIRST: Final = 0.5
"""Seconds until a session is opened again, at first, whose router did not answer."""
OPEN_RETRY_MAX: Final = 5.0
"""The longest time in seconds between two attempts to open a session."""
