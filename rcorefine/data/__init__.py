"""Measured data: records and frequency responses.

Records are checked, read from files, and matched with a model.
"""

#: Behavior of the inputs between the samples. Defined here, so that the command starts at once.
HOLDS = ("zoh", "foh", "bandlimited")
