"""What a command's exit code says. Scripts rely on these."""

DONE = 0
FAILED = 1
USAGE = 2
REFUSED = 3
"""Refused by the robot, or cancelled."""
NO_MESH = 4
