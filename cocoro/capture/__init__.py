"""The format of captures: MCAP files with every message of a robot's mesh.

`services.capture` writes them, `reader` reads them, `listed` tells what is known of one without its messages, `folder`
names the files, and `types` decodes messages as today's types. docs/captures.md describes the format for readers
without this project.
"""
