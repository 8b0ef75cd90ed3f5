"""Bounds and time-outs of the pages of the monitor; in seconds and bytes unless stated otherwise."""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB

# Between two patches of one client: some 7 a second, which looks live and is read at leisure.
PATCH_PERIOD: Final = 0.15
# Shortest time from one snapshot of the agent to the next while pages are open: one of 300 topics takes the agent
# 12 ms.
STATE_PERIOD: Final = 1.0
# The pause between two snapshots is at least so many times as long as a snapshot takes: a fifth of a core.
STATE_SHARE: Final = 4.0
# States and patches that a client has not acknowledged yet. A slow browser gets fewer patches, never a queue.
UNACKNOWLEDGED_MAX: Final = 2
# [Pages] Bytes of one message of a page: a call, or a parameter
# At it: its connection is made anew
# Told in: the line at the top of the page
REQUEST_MAX: Final = 64 * KIB
# [Pages] Messages of one page a second, in the long run
# At it: its connection is made anew
# Told in: the line at the top of the page
# Why: A joystick sends 10, acknowledgements 7.
REQUEST_RATE: Final = 50.0
# Messages of one client at once: a page that reconnects and asks for all that it shows.
REQUEST_BURST: Final = 200.0
# Things whose details one client is shown at one time; a page shows one or two.
LOOKS_MAX: Final = 4
# [Pages] Live topics of one page
# At it: a further one is refused
# Told in: the page
WATCHES_MAX: Final = 16
# [Pages] Values, images and scans of one topic a second
# At it: the newest is shown
WATCH_RATE_MAX: Final = 10.0
# [Pages] Lines of one plot
# At it: the first one is replaced
# Told in: the page
# Why: As many as can be told apart.
FIELDS_MAX: Final = 8
# [Pages] Questions of one page under way (*Why?*, calls, parameters)
# At it: a further one is refused
# Told in: the page
ASKS_MAX: Final = 16
# [Pages] Bytes of a file that describes a resource, read and changed by a page
# At it: the page neither shows nor saves it
# Told in: the page
# Why: Within a message of a page, with each quote and line end as two characters.
DESCRIPTION_MAX: Final = 24 * KIB
# Samples of a plot in one message. Of more, the least and the greatest of each part are kept.
POINTS_MAX: Final = 64
# [Pages] Characters of a text in a live value
# At it: the rest is cut
# Told in: the value
VALUE_CHARACTERS: Final = 512
# [Pages] Elements of an array in a live value
# At it: the rest is cut
# Told in: the value
VALUE_ITEMS: Final = 64
# Values in one live value, all levels together.
VALUE_NODES: Final = 2000
# [Pages] Ranges of a laser scan
# At it: of neighbours the nearest is shown
# Why: Two a degree.
SCAN_POINTS: Final = 720
# [Pages] Points of a cloud on a map
# At it: every n-th is drawn
# Told in: the list of layers
CLOUD_POINTS: Final = 8000
# [Pages] Poses of a path, or of an array of poses, on a map
# At it: every n-th is drawn
# Told in: the list of layers
PATH_POINTS: Final = 2000
# [Pages] Cells of a grid on a map
# At it: of neighbours the most occupied is drawn
# Told in: the list of layers
# Why: A browser keeps 4 bytes of each.
GRID_CELLS: Final = 2048 * 2048
# Bytes of a message whose layer is made on the event loop; a longer one's is made in a thread.
LAYER_AT_ONCE: Final = 32 * KIB
# Nodes that publish one topic, of which each is a layer of its own.
LAYER_SOURCES: Final = 32
# [Pages] Frames of tf, each sender of it counted
# At it: further ones are left out
# Told in: the page of frames
FRAMES_MAX: Final = 1000
# Characters of a frame's name; the rest is cut.
FRAME_CHARACTERS: Final = 128
# [Pages] Topics that one page publishes at a rate
# At it: a further one is refused
# Told in: the form
PUBLISHED_MAX: Final = 8
# [Pages] Messages of one of them a second
# At it: a higher rate is refused
# Told in: the form
PUBLISHED_RATE: Final = 50.0
# Bytes of a message that a page publishes: what a form of ``REQUEST_MAX`` makes.
PUBLISHED_BYTES: Final = 256 * KIB
# [Pages] Time after which a topic that a page publishes at a rate ends
# At it: nothing more is published
# Told in: the form
# Why: The page says each second that it is there; a browser stops this in a hidden page.
PUBLISH_RENEW: Final = 3.0
# [Pages] Pixels of a raw image
# At it: every n-th row and column is shown, as where its place on the screen is smaller
# Told in: the sizes below the image
IMAGE_PIXELS: Final = 1280 * 720
# Pixels of one with 16 or 32 bits a pixel, each of which is computed.
DEPTH_PIXELS: Final = 320 * 240
# The pause after a picture is at least so many times as long as it took to make: a twentieth of a core.
PICTURE_SHARE: Final = 20.0
# Pictures that were sent and that the page has not drawn yet; a slow link or browser gets fewer.
UNSEEN_MAX: Final = 2
# [Pages] Time without a message after which what is shown is old
# At it: it is greyed, and its age is shown
# Why: And five periods of the topic at the least.
OLD_AFTER: Final = 2.0
OLD_PERIODS: Final = 5.0
# Messages by which the rate of a live topic is known, and the share by which it has to change to be told again.
BEAT_MESSAGES: Final = 32
BEAT_CHANGE: Final = 0.1
# [Pages] Topics
# At it: further ones are counted; `rmpa topic list` has them
# Told in: the page of all topics
TOPICS_SHOWN: Final = 2000
# [Pages] Services
# At it: further ones are counted; `rmpa topic list` has them
# Told in: the page of all services
SERVICES_SHOWN: Final = 2000
# Nodes in a state; further ones are counted.
NODES_SHOWN: Final = 2000
# [Pages] Modules
# At it: further ones are counted; `rmpa topic list` has them
# Told in: the page of the mesh
# Why: A ring of more could not be read.
MODULES_SHOWN: Final = 256
# [Pages] Characters of a line of the log
# At it: the rest is cut
LOG_CHARACTERS: Final = 1024
# Topics of a lost link that are named; further ones are counted.
LOST_TOPICS: Final = 20
# Time after the start of this module's agent in which peers that it has not found yet do not count as lost: beacons
# come every 5 s at the latest, and links take seconds where names or addresses are resolved.
AGENT_SETTLES: Final = 10.0
# [Pages] Time for which a module that is gone is shown
# At it: it leaves the ring
FORGET_AFTER: Final = 600.0
# Seconds that an order of a page may be old: less than the page waits for a word before it gives all up.
ORDER_AGE: Final = 5.0
# [Pages] Time after a joystick's last command
# At it: the robot is stopped
# Why: A joystick sends every 0.1 s.
DRIVE_TIMEOUT: Final = 0.3
# How often the server of the page that has the stick tells other servers; a second may lose two of them.
STICK_RENEW: Final = 0.5
# [Pages] Time without a word of the server whose page has the stick
# At it: the stick is free
# Why: It tells it every 0.5 s.
STICK_EXPIRY: Final = 2.0
# Magnitude of a linear speed that a joystick may command, m/s.
DRIVE_SPEED: Final = 2.0
# Magnitude of an angular speed that a joystick may command, rad/s.
DRIVE_TURN: Final = 4.0
# Magnitude of a steering angle that a joystick may command, rad; cars have some 0.6.
DRIVE_STEER: Final = 0.6
# [Pages] Acceleration that a joystick commands, m/s²
# At it: the speed grows by a ramp; it falls at once
# Told in: the page
# Why: A gamepad's stick jumps from 0 to 1 in one command.
DRIVE_ACCELERATION: Final = 4.0
# Axes and buttons of a gamepad in one command; the largest consoles of joysticks have half of them.
AXES_MAX: Final = 32
BUTTONS_MAX: Final = 64
# [Pages] Smart Resources that are followed
# At it: others are not shown
# Why: Paths of them; each is up to nine subscriptions.
RESOURCES_MAX: Final = 256
# Time for which the details of a Smart Resource are followed after a page has shown it.
LOOK_KEPT: Final = 10.0
# Numbers of values of ``/diagnostics`` whose past is kept, all statuses together: some 4 MB.
DIAGNOSTIC_HISTORY: Final = 500_000
# Changes of the worst level of all statuses that are remembered.
DIAGNOSTIC_WORST: Final = 200
# [Pages] Statuses at ERROR under *What is wrong*
# At it: further ones are counted
# Told in: the page of the mesh
DIAGNOSTIC_ERRORS: Final = 20
# Of these, errors of one node.
DIAGNOSTIC_ERRORS_NODE: Final = 5
# Time between two questions for the rates of all topics, while a page shows their list.
RATES_PERIOD: Final = 3.0
# Time between two signs of life to a page, which takes its connection for lost after three without any.
TICK_PERIOD: Final = 2.0
# Pause before it is looked again whether a page has taken what was sent.
UNSENT_RETRY: Final = 0.1
# Questions of all pages together that wait for the agent, each in a thread: `why` takes seconds.
ANSWERS_AT_ONCE: Final = 4
# The longest pause between two snapshots.
STATE_PAUSE_MAX: Final = 0.5
