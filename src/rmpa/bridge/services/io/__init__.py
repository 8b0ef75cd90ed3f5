"""The I/O of services across modules: endpoints, connections to servers, requests and replies on links."""
