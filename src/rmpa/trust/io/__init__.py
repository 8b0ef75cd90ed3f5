"""The I/O of trust: the files of a member and of the authority."""
