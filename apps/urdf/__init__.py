"""A robot description from a URDF: reading, conversion, and what a URDF does not say."""
