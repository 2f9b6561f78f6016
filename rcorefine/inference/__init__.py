"""Estimation of coefficients from records.

It covers whitening, sensitivities, optimization, covariance and tests.
"""
