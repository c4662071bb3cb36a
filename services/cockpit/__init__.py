"""The cockpit: one page in a browser that shows the robot, stops it, and has it carry out tasks."""
