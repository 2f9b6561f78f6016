"""Estimation of coefficients on a stream.

One re-linearized joint filter estimates entries of the model or physical effects.
"""
