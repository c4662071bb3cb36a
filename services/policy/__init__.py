"""Runs learned policies: observes, has a policy act, and proposes its actions to the planner."""
