"""Learns the appearance of a new object from one picture: its pixels, its colours, its size.

Pure functions over pixels, used by `cocoro objects learn`.
"""
