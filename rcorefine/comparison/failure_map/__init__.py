"""Failures of a model in time, frequency, amplitude, state and place."""
