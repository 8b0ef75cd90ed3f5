"""The I/O of parameters across modules: the local core, the owner's side and the follower's side."""
