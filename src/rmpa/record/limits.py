"""Limits and time-outs of the recorder, with their reasons; in seconds and bytes unless stated otherwise."""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import MIB

# [Recording] Bytes that wait for the disk
# At it: the largest topics lose their newest messages
# Told in: the recording's events, `rmpa record info`
# Why: A slow SD card must not take the robot's memory.
QUEUE_BYTES: Final = 64 * MIB
# A segment of the ring has so many seconds: what one cut loses at the most, and how exactly the ring is bounded.
SEGMENT: Final = 5.0
# Seconds after which what is in memory is written: what a crash loses at the most.
FLUSH: Final = 0.5
# [Recording] Bytes of a chunk before it is compressed
CHUNK: Final = MIB
# [Recording] Latched messages that each segment repeats, bytes of one topic's publisher
# At it: it is not repeated
# Told in: the recording's events
LATCHED_MAX: Final = 8 * MIB
# Seconds by which a clock was set at least, where segments say so: less is no step, but its steady correction.
CLOCK_STEP: Final = 0.05
# What could not be kept, by name, that the status has.
FAILED: Final = 16
# Seconds between two tries to write again on a full or read-only disk.
RETRY: Final = 5.0
# Least seconds between two recordings that are kept for the same reason.
KEEP_AGAIN: Final = 10.0
