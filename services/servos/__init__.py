"""The servos: families (data), bus, the thread of a line, motion and network (pure), and the service."""
