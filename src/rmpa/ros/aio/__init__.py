"""Former place of ``rmpa.ros.node``; only ``rmpa.ros.aio.node``, which the documentation named, is still found."""
