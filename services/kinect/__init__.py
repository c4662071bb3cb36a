"""The Kinect: frames of colour and raw depth, stamped by the robot's clock."""
