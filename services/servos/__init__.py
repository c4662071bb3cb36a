"""The servos: both Dynamixel networks, arm and neck, and hand."""
