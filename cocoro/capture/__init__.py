"""Captures are MCAP files with every message of a robot's mesh. Here is their format, and reading them.

`reader.Capture` opens one and gives its messages; `types` reads them as today's message types. The recorder writes
them (`services.capture`). docs/captures.md describes the format for readers without this project.
"""
