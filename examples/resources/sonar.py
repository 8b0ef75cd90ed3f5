"""A simulated sonar with three System Profiles: rmpa run examples/resources/sonar.py."""

import math
import random
import time

from rmpa.resource import Resource

sonar = Resource("sonar", role="sensing", physical=False, description="the distance to a wall that comes and goes")
ranges = sonar.output("ranges", "sensor_msgs/Range", deadline="500 ms")
cone = sonar.parameter("cone", 0.3, low=0.05, high=1.0, unit="rad", description="opening of the beam")
accuracy = sonar.attribute("accuracy", better="min", unit="m", category="spatial")
echoes = sonar.parameter("echoes", 1, low=1, high=1000, description="averaged for one measurement; profiles set it")


@sonar.profile(offers={"rate": "20 Hz", "accuracy": "20 cm"}, cost=1, best_effort=True)
def quick() -> None:
    """One echo a measurement."""
    echoes.value = 1


@sonar.profile(offers={"rate": "20 Hz", "accuracy": "5 cm"}, cost=4)
def fine() -> None:
    """Sixteen echoes a measurement."""
    echoes.value = 16


@sonar.profile(offers={"rate": "20 Hz", "accuracy": "1 cm"}, cost=40)
def exact() -> None:
    """Four hundred echoes a measurement."""
    echoes.value = 400


@sonar.task(rate="20 Hz")
def measure() -> None:
    """Send a measurement, and say how exact it is."""
    true = 2.0 + math.sin(time.monotonic() / 5)
    count = echoes.value
    distance = true + sum(random.gauss(0, 0.18) for _ in range(count)) / count
    ranges.publish(
        header={"stamp": time.time()}, field_of_view=cone.value, min_range=0.1, max_range=5.0, range=distance
    )
    accuracy.observe(0.18 / math.sqrt(count))
