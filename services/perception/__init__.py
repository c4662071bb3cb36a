"""Perception: finds the known objects in each frame, and their positions in the body frame.

`image`: a frame as arrays, and what detectors return. `registration`: depth at the colour pixels. `colours`: which
objects' colours each pixel has. `blob` and `paper`: the detectors. `runs`, `segments`, `sizes` and `evidence`: what
`blob` does for all regions at once; `pieces` and `region`: for an object in several pieces. `shapes`, `rays`, `fit` and
`localise`: from pixels and depth to objects' centres. `floor`: obstacles and free floor. `core`: the service's
computation. `service`: its shell.
"""
