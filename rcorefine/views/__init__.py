"""Tables, pictures and reports of results.

Each view registers itself for the class that it shows.
"""

from . import (
    amplitude_response,
    check,
    comparison,
    damage_map,
    data,
    diagnosis,
    exercises,
    experiment,
    failure_map,
    hidden_force,
    improvement,
    measurement,
    monitor,
    pages,
    physical_model,
    refinement,
    refiner,
    residuals,
    responses,
    survey,
)
from .bode import bode_comparison
from .tables import html_table, text_table

__all__ = [
    "amplitude_response",
    "bode_comparison",
    "check",
    "comparison",
    "damage_map",
    "data",
    "diagnosis",
    "exercises",
    "experiment",
    "failure_map",
    "hidden_force",
    "html_table",
    "improvement",
    "measurement",
    "monitor",
    "pages",
    "physical_model",
    "refinement",
    "refiner",
    "residuals",
    "responses",
    "survey",
    "text_table",
]
