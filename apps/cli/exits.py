"""Exit codes of the commands. Scripts rely on them."""

DONE = 0
FAILED = 1
USAGE = 2
REFUSED = 3
"""Refused by the robot, or cancelled."""
NO_MESH = 4

USAGE_REFUSALS = ("unknown_label", "not_graspable", "bad_request", "not_able")
"""Refusals that no state of the robot would change: their exit code is USAGE."""
