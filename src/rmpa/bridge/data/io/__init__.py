"""The data path: flows from publishers to links and from links to subscribers, with the time base of a link."""
