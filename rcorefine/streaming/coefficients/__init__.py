"""Coefficients on a stream: entries of the model or physical effects, by one re-linearized joint filter."""
