"""What the process needs of the operating system: event loop, sockets, descriptors, threads and timers."""
