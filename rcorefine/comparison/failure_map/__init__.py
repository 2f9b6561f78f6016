"""Where a model fails: over time, frequency, amplitude, state space and place."""
