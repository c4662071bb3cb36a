"""Exit codes of the commands. Scripts rely on them."""

DONE = 0
FAILED = 1
USAGE = 2
REFUSED = 3
"""Refused by the robot, or cancelled."""
NO_MESH = 4
