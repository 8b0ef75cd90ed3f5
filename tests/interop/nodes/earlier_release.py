"""Run a program of rmpa, the first argument, as a release that does not know direct transport."""

import runpy
import sys

from rmpa.bridge.direct import requests

# What nobody asks for is not answered: the names of all requests and notifications are others here.
for name in ("OPEN", "CLOSE", "CLOSED", "RETRY"):
    setattr(requests, name, f"earlier.{name}")

sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
