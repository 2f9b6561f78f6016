"""Measured data: records and frequency responses.

Records are checked, read from files, and matched with a model.
"""

#: Behavior of the inputs between the samples. It stands here for the terminal, which is to start at once.
HOLDS = ("zoh", "foh", "bandlimited")
