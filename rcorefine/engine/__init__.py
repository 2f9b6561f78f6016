"""A model in feedback with effects, run over a record: simulation, observer, harmonic balance."""
