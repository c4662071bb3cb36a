"""The emergency stop's own path, beside the mesh: from a `cocoro stop` to every process that moves something.

It needs no shared memory, disk, register, router, name service or environment variable, and only Python's standard
library.

- `path`: the receiving side, in each process that moves something.
- `record`: the latch on disk, which survives every process and a reboot.
- `asking`: the sending side.

Every user of the robot's machine may stop it. Only its owner may reset it, since a reset goes over the mesh, whose
directory is the owner's alone.
"""
