"""Checks of a record and a model before any other analysis."""
