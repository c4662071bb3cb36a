"""The planner: fuses the latest of everything by time and turns the executive's intent into commands."""
