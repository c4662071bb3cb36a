"""The paper's experiments in virtual time: rehearsals over many seeds, judged by the simulator's truth.

`every` runs them; a module for each experiment says which runs it needs and what its report has.
"""
