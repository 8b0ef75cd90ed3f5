"""A camera whose pictures are large under one profile and small under another: the link's load is its choice."""

from rmpa.resource import Resource

camera = Resource("camera", role="sensing", physical=False)
frames = camera.output("frames", "std_msgs/String")
sharpness = camera.attribute("sharpness", better="max", unit="", category="spatial")
exposure = camera.parameter("exposure", 1.0, low=0.0, high=10.0)
camera.adaptation(window="500 ms", dwell="500 ms", settle="1500 ms", cool_down="4 s")
SIZES = {"full": 64_000, "small": 2_000, "rescue": 200}
picture = {"name": ""}


@camera.profile(offers={"rate": "20 Hz", "sharpness": 640}, cost=10)
def full() -> None:
    """10 Mbit/s."""
    picture["name"] = "full"


@camera.profile(offers={"rate": "20 Hz", "sharpness": 160}, cost=1)
def small() -> None:
    """A thirtieth of that."""
    picture["name"] = "small"


@camera.profile(offers={"rate": "2 Hz", "sharpness": 80}, best_effort=True)
def rescue() -> None:
    """What can be had if nothing else can."""
    picture["name"] = "rescue"


@camera.task(rate="20 Hz")
def shoot() -> None:
    """Send a picture."""
    name = picture["name"]
    frames.publish(data=name.ljust(SIZES[name], "x"))
    sharpness.observe({"full": 640, "small": 160, "rescue": 80}[name])
