"""A camera whose pictures are large under one profile and small under another: the link's load is its choice."""

from rmpa.resource import Resource

camera = Resource("camera", role="sensing", physical=False)
frames = camera.output("frames", "std_msgs/String")
sharpness = camera.attribute("sharpness", better="max", unit="", category="spatial")
exposure = camera.parameter("exposure", 1.0, low=0.0, high=10.0)
camera.adaptation(window="500 ms", dwell="500 ms", settle="1500 ms", cool_down="4 s")
picture = {"name": "", "bytes": 0}


@camera.profile(offers={"rate": "20 Hz", "sharpness": 640}, cost=10)
def full() -> None:
    """10 Mbit/s."""
    picture.update(name="full", bytes=64_000)


@camera.profile(offers={"rate": "20 Hz", "sharpness": 160}, cost=1)
def small() -> None:
    """A thirtieth of that."""
    picture.update(name="small", bytes=2_000)


@camera.profile(offers={"rate": "2 Hz", "sharpness": 80}, best_effort=True)
def rescue() -> None:
    """What can be had if nothing else can."""
    picture.update(name="rescue", bytes=200)


@camera.task(rate="20 Hz")
def shoot() -> None:
    """Send a picture."""
    frames.publish(data=str(picture["name"]).ljust(int(picture["bytes"]), "x"))
    sharpness.observe({"full": 640, "small": 160, "rescue": 80}[str(picture["name"])])
