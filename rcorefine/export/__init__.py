"""A refined model as the code of another program: python-control alone, MATLAB, Modelica, C."""
