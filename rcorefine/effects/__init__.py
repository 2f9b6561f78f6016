"""Effects: laws at places, their coefficients, their forces."""
