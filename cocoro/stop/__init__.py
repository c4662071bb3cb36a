"""The emergency stop's own path: from whoever says stop to every process that moves something, beside the mesh.

It needs no shared memory, no disk, no register, no router, no name service and no environment variable, and nothing
but Python's standard library.

- `path`: where a process that moves something listens, and what it does when somebody says stop.
- `asking`: how to say stop to all of them, and what they answered.
- `record`: the latch on disk, which outlives every process and a reboot.

Everybody who can log in to the robot's machine may stop it. Only its owner may reset it, since a reset goes over the
mesh, whose directory is the owner's alone.
"""
