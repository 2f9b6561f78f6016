"""Fit of the free parameters of a model before any test."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..data.measurement import Measurement
from ..data.response_record import in_frequency
from ..effects.effect import Effect
from ..engine.simulation import check_channels
from ..engine.structure import Structure
from ..inference.assembly import assemble, offset_variants, unfold
from ..inference.fit import Fit
from ..inference.outcome import output_weights, package
from ..inference.refinement import Refinement
from ..inference.search import starting_states
from ..inference.windows import windows
from ..models.operating_point import ordered_record
from .refine import refine

__all__ = ["base_fit"]


def base_fit(
    model: Any,
    records: Sequence[Measurement],
    *,
    free: Any,
    tolerance: float,
    offset: bool,
    noise: Any,
    horizon: float | None = None,
) -> Refinement:
    """The model fitted as far as it is declared to be free.

    Where its numbers are trusted, or known to within a prior, the minimum is next to them and no
    search is needed.
    """
    if len(free) and tolerance == 0 and not all(isinstance(e, Effect) and e.prior for e in free):
        return refine(
            model, records, free=free, tolerance=tolerance, offset=offset, noise=noise, horizon=horizon
        )
    physical, kept = unfold(model)
    ordered = [ordered_record(physical, r) for r in records]
    if not in_frequency(ordered):
        for measured, record in zip(records, ordered, strict=True):
            check_channels(physical.linear, record)
            if measured.n_inputs:
                record.check_excitation("diagnose")
    segments, note = windows(physical, ordered, horizon)
    chosen = assemble(physical, kept, (), free, tolerance, offset_variants(physical, ordered[0], offset)[0])
    constants = dict(getattr(model, "constants", {}))
    structure = Structure(physical, [e for e, _ in chosen], constants=constants)
    fit = Fit(structure, [role for _, role in chosen], segments, noise, None, tolerance)
    fit.steps = int(getattr(model, "substeps", 1))
    if structure.field is not None:  # not even what it starts from is exact in one substep
        fit.resume(fit.steps, np.zeros((0, 0)))
        return package(fit, physical, note)
    fit.problem = fit.build(segments, fit.steps)
    theta = structure.start()
    fit.result = fit.problem.minimize(
        fit.problem.pack(theta, starting_states(fit.problem, theta)), max_nfev=30, tol=1e-8
    )
    for _ in range(2):  # noise levels from the residual, then the weight of the priors
        fit.weights = output_weights(segments, noise, fit.problem, fit.result.x)
        fit.problem = fit.build(segments, fit.steps)
        fit.result = fit.problem.minimize(fit.result.x, max_nfev=30, tol=1e-10)
        if noise is not None or (structure.n_outputs == 1 and tolerance == 0):
            break
    return package(fit, physical, note)
