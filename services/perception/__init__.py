"""Perception: finds the known objects in each frame, and their positions in the body frame.

`image`: a frame as arrays, depth registered on demand, and what detectors return. `colours`: which objects' colours
each pixel has. `blob` and `paper`: the detectors. `shapes` and `localise`: from pixels and depth to an object's
centre. `floor`: obstacles and free floor. `core`: the service's computation. `service`: its shell.
"""
