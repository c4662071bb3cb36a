"""The Dynamixel servos: registers (`table`), bus, the line's thread, motion and network (the pure cores), the service."""
