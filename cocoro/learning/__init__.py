"""What the robot learns of its own body by moving and looking: pure, no I/O but for the two file formats."""
