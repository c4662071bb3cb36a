"""Captures: MCAP files with all that travelled on a robot's mesh. Written, read, mended, played and looked at here.

docs/captures.md says what is in one, for readers that know nothing of this project.
"""
