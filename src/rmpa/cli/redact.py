"""Takes out of a text what no other person is to see."""

from __future__ import annotations

import re

_USER_INFO = re.compile(r"(\w+://)[^/\s@\"']+@")


def without_passwords(text: str) -> str:
    """A text whose addresses have no user names and passwords."""
    return _USER_INFO.sub(r"\1[redacted]@", text)
