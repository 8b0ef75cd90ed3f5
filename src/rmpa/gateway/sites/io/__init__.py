"""The I/O of sites: what crosses between this site and others, by the gateway's graph and its Zenoh session."""
