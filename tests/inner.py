"""Inner names that several test files use: when a module moves, this is the one place to change."""

from rcorefine.commands.cli import main
from rcorefine.commands.example import example_csv
from rcorefine.diagnosis import residual_tests
from rcorefine.diagnosis.case import Case
from rcorefine.diagnosis.hypothesis import Hypothesis, Start
from rcorefine.diagnosis.search import Search
from rcorefine.diagnosis.verdict import answer
from rcorefine.effects.effect import unit_forces
from rcorefine.effects.formula import FormulaLaw
from rcorefine.effects.law import KINDS
from rcorefine.engine.amplitude_response import ResponseEngine
from rcorefine.engine.engine import Engine
from rcorefine.engine.nonlinear import nonlinear_system
from rcorefine.engine.structure import Structure
from rcorefine.gauss_newton import Rows, gauss_newton, promised
from rcorefine.inference.covariance import stable_model
from rcorefine.inference.f_tests import f_test, project, rank_basis
from rcorefine.inference.fitted import fitted_from
from rcorefine.inference.levels import levels
from rcorefine.inference.problem import Problem
from rcorefine.inference.sensitivities import candidate_columns
from rcorefine.inference.starts import estimated_motion
from rcorefine.inference.whitening import Whitener
from rcorefine.jit import NUMBA
from rcorefine.models.conversion import as_physical
from rcorefine.models.operating_point import ordered_record
from rcorefine.progress import Progress
from rcorefine.refinement.refine import base_fit
from rcorefine.results import Data
from rcorefine.streaming.filter import BlockFilter
from rcorefine.systems import to_discrete
from rcorefine.systems.linear import LinearModel
from rcorefine.systems.response import bode_error
from rcorefine.views.bode import bode
from rcorefine.views.figures import Frame
from rcorefine.views.page import Page, write_page
from rcorefine.views.tables import TextTable


def bode_comparison(systems, measured=None, omega=None, **options):
    """Bode plot of systems in a frame of these options."""
    return bode(systems, measured, omega, Frame(**options))


__all__ = [
    "KINDS",
    "NUMBA",
    "BlockFilter",
    "Case",
    "Data",
    "Engine",
    "FormulaLaw",
    "Frame",
    "Hypothesis",
    "LinearModel",
    "Page",
    "Problem",
    "Progress",
    "ResponseEngine",
    "Rows",
    "Search",
    "Start",
    "Structure",
    "TextTable",
    "Whitener",
    "answer",
    "as_physical",
    "base_fit",
    "bode_comparison",
    "bode_error",
    "candidate_columns",
    "estimated_motion",
    "example_csv",
    "f_test",
    "fitted_from",
    "gauss_newton",
    "levels",
    "main",
    "nonlinear_system",
    "ordered_record",
    "project",
    "promised",
    "rank_basis",
    "residual_tests",
    "stable_model",
    "to_discrete",
    "unit_forces",
    "write_page",
]
