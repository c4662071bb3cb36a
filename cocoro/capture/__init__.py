"""The format of captures: MCAP files with every message of a robot's mesh.

`services.capture` writes them, `apps.captures.reader` reads them, and `types` decodes their messages as today's types.
docs/captures.md describes the format for readers without this project.
"""
