"""The learned model of the robot's own body: network, hand-eye map, and the model's file."""
