"""A Create and Dynamixel buses at the other end of a wire: they speak the manuals' bytes on pseudo-terminals.

Written from the manuals and sharing no code with the drivers, so that what the two agree on is what the manuals say.
Behind the bytes is a body: the PyBullet world's (profile `sim-wire`), or a simple one for tests and first steps.
"""
