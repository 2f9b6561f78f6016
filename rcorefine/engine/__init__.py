"""Simulation, observer and harmonic balance of a model with effects.

The effects act in feedback on the model; the engine runs both over a record.
"""
