"""Stands for ``rmpa run FILE``: it is active at once, until a signal; words in the file have it fail.

A ``# fail`` ends it with code 1, ``# usage`` with 2, ``# crash`` with code 1 once it has been active.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

path = Path(sys.argv[sys.argv.index("run") + 1])
directory = Path(sys.argv[sys.argv.index("--state") + 1]) / sys.argv[sys.argv.index("--name") + 1]
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
signal.signal(signal.SIGINT, lambda *_: sys.exit(0))
text = path.read_text()
print(f"runs {path.name}", flush=True)
for word, code in (("# fail", 1), ("# usage", 2)):
    if word in text:
        print("something is missing", flush=True)
        sys.exit(code)
began = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
name = path.name.partition(".")[0]
node = {
    "key": "driver",
    "node": "/driver",
    "state": "running",
    "pid": os.getpid(),
    "mark": [os.getpid(), began, boot],
}
run = {
    "process": [os.getpid(), began, boot],
    "state": "unconfigured" if "# slow" in text else "active",
    "nodes": [node],
}
(directory / "run").mkdir(parents=True, exist_ok=True)
(directory / "run" / "new").write_text(json.dumps(run))
(directory / "run" / "new").rename(directory / "run" / f"{name}.json")
if "# crash" in text:
    path.write_text("")
    sys.exit(1)
while True:
    time.sleep(60)
