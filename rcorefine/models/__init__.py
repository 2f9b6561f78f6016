"""Initial model and its places.

The model is built by a builder, recognized in a `StateSpace`, or read from a file.
"""
