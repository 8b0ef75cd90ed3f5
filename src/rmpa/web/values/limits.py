"""Bounds of the conversion between ROS 1 bytes and values."""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import MIB

CODECS_MAX: Final = 512
"""Compiled types in the cache of the process; a module has some 50 types. The least recently used is dropped."""
TYPE_VALUES_MAX: Final = 100_000
"""Values that a message without elements in its arrays of any length has; a covariance has 36, a type rarely 200."""
TYPE_SIZE_MAX: Final = 16 * MIB
"""Bytes of the smallest message of a type: it has fixed arrays of this size together."""
WRITTEN_MAX: Final = 64 * MIB
"""Bytes of a message that is written from values."""
VALUES_PER_BYTE: Final = 16
"""Values read for each byte of a message: messages within arrays that have no bytes could be any number."""
VALUES_FREE: Final = 10_000
"""Values that any message may have beyond that."""
INLINE_MAX: Final = 64
"""Numbers of an embedded message that are read in one step with those around it."""
MISSING_NAMED: Final = 8
"""Fields that were not given and are named to the client."""
SHOWN: Final = 60
"""Characters of a wrong value in an error."""
