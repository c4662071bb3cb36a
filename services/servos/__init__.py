"""The servos: families (data), bus, the thread of a line, motion and group (pure), and the service."""
