"""The web room: monitor, REST, metrics, rosbridge and Foxglove clients (extra ``rmpa[web]``)."""
