"""The paper's experiments in virtual time: rehearsals over many seeds, judged by the simulator's truth.

`experiments` runs them. The module of an experiment (`e1_...`) lists the runs that it needs, and makes its section of
the report.
"""
