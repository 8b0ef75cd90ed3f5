"""The web room: monitor, REST, metrics, and the gateways for rosbridge and Foxglove clients (extra ``rmpa[web]``)."""
