"""A lamp with parameters of all types, profiles of which one cannot be applied, contexts by rule and by hand."""

from rmpa.resource import Resource, at_least

lamp = Resource("lamp", role="acting", physical=False)
light = lamp.output("light", "std_msgs/String")
heat = lamp.output("heat", "std_msgs/String")
level = lamp.parameter("level", 1.0, low=0.0, high=10.0, unit="V", description="of the supply")
steps = lamp.parameter("steps", 3, low=1)
on = lamp.parameter("on", True)
colour = lamp.parameter("colour", "white", choices=("white", "blue"), description="of the light")


@lamp.profile(offers={"rate": "10 Hz"}, cost=1, best_effort=True)
def slow() -> None:
    """Saves."""


@lamp.profile(offers={"rate": "20 Hz"}, cost=5)
def fast() -> None:
    """Shines."""


@lamp.profile(offers={"rate": "40 Hz"}, cost=9)
def broken() -> None:
    """Needs a bulb."""
    raise OSError("no such bulb")


lamp.context("docked", when="/battery/charging and ~level > 3", requires={"rate": at_least("15 Hz")}, outputs=[light])
lamp.context("away", profiles=["slow"])


@lamp.task(rate="20 Hz")
def shine() -> None:
    """Say which colour."""
    light.publish(data=colour.value)
    heat.publish(data=colour.value)
