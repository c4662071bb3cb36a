"""An emulated Create and emulated servos of two families, which speak the manuals' bytes on pseudo-terminals.

Written from the manuals, without code shared with the drivers: what both agree on is in the manuals. A plant is behind
the bytes: the PyBullet world (profile `sim-wire`), or a simple one for tests and first steps.
"""
