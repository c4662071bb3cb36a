"""The client for programs: operate a robot from Python, as the `cocoro` command does, which stands on it.

`cocoro.connect`, `cocoro.connect_blocking` and `cocoro.open` are the way in (docs/client.md). Of the parts, `task_run`
follows one task over the mesh, `handle` is a task for programs, `robot` what a program can do, `link` the access to a
robot's mesh.
"""
