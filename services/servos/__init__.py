"""The Dynamixel servos: registers (`table`), bus, the thread of a line, motion and network (pure), and the service."""
