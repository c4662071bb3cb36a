"""Dynamixel servos: their registers (`table`), packets, port and bus; motion and networks; the service."""
