"""Perception: which known objects a frame shows, and where they stand in the body frame.

`image` a frame as arrays, with its depth registered where it is asked for; `colours` which objects' colour a
pixel has; `blob` and `paper` the detectors; `shapes` and `localise` from pixels and depth to the
object's centre; `core` the service's maths over time; `service` its shell.
"""
