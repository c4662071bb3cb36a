"""What a new object looks like, from one picture of it: where it is, which colours are its, how large it is.

Pure functions over pixels; `cocoro objects learn` is their user.
"""
