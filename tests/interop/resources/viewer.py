"""What needs the camera's pictures, and is stale without them."""

from typing import Any

from rmpa.resource import Resource

viewer = Resource("viewer", role="controlling")
frames = viewer.input("/camera/frames", "std_msgs/String")
seen = viewer.output("seen", "std_msgs/UInt32")
viewer.adaptation(window="500 ms")


@viewer.profile(offers={"rate": "20 Hz"})
def look() -> None:
    """Look at each."""


@viewer.task(on=frames)
def see(picture: Any) -> None:
    """Say how large it is."""
    seen.publish(data=len(picture.data))
