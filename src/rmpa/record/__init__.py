"""The flight recorder: what happened on a module, in segments of MCAP that are kept when something goes wrong.

``rmpa record`` runs it beside the agent, as a subscriber like rosbag (docs/guides/recording.md).
"""
