"""Shows what is said on /chatter, until Ctrl-C."""

from typing import Any

import rmpa


def heard(message: Any) -> None:
    """Show one message."""
    print(f"heard: {message.data}", flush=True)


with rmpa.connect("listener", anonymous=True) as node:
    node.subscribe("/chatter", "std_msgs/String", heard)
    node.spin()
