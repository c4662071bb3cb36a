"""A whole robot in one process and in virtual time, judged by the truth of the simulator."""
