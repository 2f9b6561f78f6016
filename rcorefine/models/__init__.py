"""The initial model with its places: built, recognized in a `StateSpace`, read from files."""
