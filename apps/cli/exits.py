"""Exit codes of the commands. Scripts rely on them."""

DONE = 0
FAILED = 1
USAGE = 2
REFUSED = 3
"""Refused by the robot, or cancelled."""
NO_MESH = 4

USAGE_REFUSALS = ("unknown_label", "not_graspable", "bad_request")
"""Refusals of the robot that are the operator's mistake, not the robot's state: their exit code is USAGE."""
