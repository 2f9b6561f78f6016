"""Course exercises: records with a hidden effect, and their grading.

Each student gets another record.
"""

from .exercise import Exercise, Grade, Grades, Mark, grade, hidden_effect, load_exercise
from .plants import PLANTS as _PLANTS

__all__ = ["Exercise", "Grade", "Grades", "Mark", "grade", "hidden_effect", "load_exercise", "plants"]

#: Names of the plants, one for each lab.
plants = tuple(_PLANTS)
