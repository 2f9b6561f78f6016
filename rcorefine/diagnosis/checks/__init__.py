"""The door before every other question: what is odd about a record, or about a model beside it."""

from .check import check
from .result import Check, CheckRow

__all__ = ["Check", "CheckRow", "check"]
