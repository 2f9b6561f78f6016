"""Export of a refined model as the code of another program.

The targets are python-control alone, MATLAB and C.
"""
