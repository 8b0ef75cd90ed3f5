"""Wire formats without I/O: HTTP, XML-RPC, the Slave API, TCPROS and its services."""
