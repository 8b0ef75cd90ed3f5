"""The I/O of discovery: sockets, interfaces, seeds, and the task that drives the membership machine."""
