"""The Kinect: colour and raw depth, stamped by the robot's clock."""
