"""The paper's experiments, run anew in virtual time: rehearsals over many seeds, judged by the simulator's truth."""
