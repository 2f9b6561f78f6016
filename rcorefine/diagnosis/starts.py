"""Where rivals start: absent, after one linear step, led by observers, from the force of another law."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..effects.along_motion import unit_forces
from ..engine.observer import observer_gain
from ..engine.point import resting, tangents
from ..inference.descent import Descent, descend
from ..inference.fitted import FittedModel
from ..inference.logarithms import by_logarithms
from ..inference.problem import Problem
from ..inference.search import starting_states
from ..inference.sensitivities import Candidate
from ..models.operating_point import sensed
from ..systems.linear import Array

__all__ = ["at_home", "force_along", "gain_for", "imitated", "led", "observed", "plain_cost", "regressed"]

_OBSERVERS = (1.0, 0.1)
_FALLING = (1.0, 0.1, 0.01)
_BENT = 0.5  # standard deviations of the declared tolerance that count as bent
_LIMITS = {
    "gap": (0.0,),
    "displacement": (1e-3, 3.0),
}  # of the rms displacement: where a law turns into another


def gain_for(fitted: FittedModel, candidate: Candidate, ratio: float) -> Array | None:
    """One gain for all rivals, so that all are compared in the same metric; None for the free run."""
    gain = fitted.gain(ratio)
    if gain is None:
        return None
    return np.pad(gain, ((0, candidate.problem.n_states - gain.shape[0]), (0, 0)))


def plain_cost(problem: Problem, point: Array, gain: Array | None) -> float:
    """Half the sum of squares, without derivatives; inf where the simulation blows up."""
    theta, starts = problem.unpack(problem.inside(point))
    total = 0.0
    for engine, start in zip(problem.engines, starts, strict=True):
        run = engine.run(theta, start, sensitivity=False, gain=gain, check=False)
        error = problem.weights[:, None] * (run.outputs - engine.data.outputs)
        if run.blew_up >= 0 or not np.isfinite(error).all():
            return np.inf
        total += 0.5 * float(np.sum(error**2))
    return total


def at_home(problem: Problem, points: Sequence[Array]) -> list[Array]:
    """The same points with the linear parameters as declared: the fit without the effect bent them."""
    held = np.isfinite(problem.prior_sd)
    found = []
    for point in points:
        theta, starts = problem.unpack(point)
        home = np.where(held, problem.prior_mean, theta)
        if np.any(np.abs(home - theta) > _BENT * problem.prior_sd, where=held):
            found.append(problem.pack(home, starts))
    return found


def regressed(fitted: FittedModel, candidate: Candidate) -> list[Array]:
    """One linear step per observer: right where the law is linear in its coefficients."""
    problem, start = candidate.problem, candidate.starts[0]
    p, q = fitted.problem.n_theta, problem.n_theta
    points = []
    if not problem.in_time:
        points.append(by_logarithms(problem, problem.inside(start)))
    for observer in _OBSERVERS:
        columns = candidate.columns.get(observer)
        if columns is None or columns[0].shape[2] != q - p:
            continue
        blocks = fitted.blocks(observer)
        r = np.concatenate([block.ravel() for block, _ in blocks])
        J = np.concatenate(
            [
                np.concatenate([jacobian[:, :, :p], column], axis=2).reshape(block.size, q)
                for (block, jacobian), column in zip(blocks, columns, strict=True)
            ]
        )
        held = np.isfinite(problem.prior_sd)
        rows = np.diag(1.0 / problem.prior_sd[held])
        J = np.vstack([J, rows @ np.eye(q)[held]]) if held.any() else J
        theta = problem.unpack(start)[0]
        pull = (theta[held] - problem.prior_mean[held]) / problem.prior_sd[held]
        size = np.linalg.norm(J, axis=0)
        size[size == 0] = 1.0
        unit = J / size
        step = np.linalg.lstsq(unit.T @ unit, -unit.T @ np.append(r, pull), rcond=1e-10)[0] / size
        point = start.copy()
        point[:q] += step
        points.append(problem.inside(point))
    if problem.structure.is_linear and problem.free_start:
        points.append(_from_rest(problem, _home(fitted, problem.unpack(start)[0]), p))
    return points


def _home(fitted: FittedModel, theta: Array) -> Array:
    """The coefficients with linear parameters and offsets as declared, before any fit bent them."""
    roles, parameters = fitted.refinement.roles, fitted.structure.parameters
    theta = theta.copy()
    theta[[i for i, q in enumerate(parameters) if roles[q.effect] in ("linear", "offset")]] = 0.0
    return theta


def _from_rest(problem: Problem, theta: Array, p: int) -> Array:
    """The effect after one linear step from rest, the initial states such as suit it.

    States and offsets that were fitted without the effect hold it back: a gain multiplies them.
    """
    rest = problem.pack(theta, np.zeros((len(problem.records), problem.n_states)))
    r, J = problem.evaluate(rest).condensed
    size = np.linalg.norm(J, axis=0)
    size[size == 0] = 1.0
    unit = J / size
    step = np.linalg.lstsq(unit.T @ unit, -unit.T @ r, rcond=1e-10)[0] / size
    theta = np.append(theta[:p], problem.inside(rest + step)[p : problem.n_theta])
    return problem.pack(theta, starting_states(problem, theta))


def observed(fitted: FittedModel, candidate: Candidate, start: Array, ratio: float) -> Array:
    """Where observer-led fits of falling gain take the coefficients."""
    problem, point = candidate.problem, start
    if not problem.in_time:
        return by_logarithms(problem, problem.inside(point))
    for observer in _OBSERVERS:
        if observer > ratio:
            gain = gain_for(fitted, candidate, observer)
            point = descend(problem, point, gain=gain, evaluations=4, tolerance=1e-2).point
    return problem.pack(problem.unpack(point)[0], problem.unpack(start)[1])


def led(fitted: FittedModel, candidate: Candidate, start: Array, ratio: float) -> Descent:
    """A second start: nuisances as declared, then led by observers of falling gain into the free run.

    A strong effect moves the resonances, and what the fit without it bent holds every
    rival in its valley. The observer's gain is that of the model as it then is.
    """
    problem = candidate.problem
    theta, starts = problem.unpack(start)
    point = problem.inside(problem.pack(_home(fitted, theta), starts))
    gain = gain_for(fitted, candidate, ratio)
    tries = []
    if not problem.in_time and problem.structure.is_linear:
        tries = [by_logarithms(problem, point), by_logarithms(problem, problem.inside(start))]
    for observer in _FALLING if problem.in_time else ():
        if observer <= ratio:
            break
        theta = problem.unpack(point)[0]
        try:
            strong = observer_gain(problem.structure, theta, problem.records[0], observer, at=fitted.force_at)
        except (np.linalg.LinAlgError, ValueError):
            continue  # a model that this observer does not exist for; the next is weaker
        run = descend(problem, point, gain=strong, evaluations=6, tolerance=1e-3)
        if np.isfinite(run.cost):
            point = run.point
            tries += [point, problem.pack(problem.unpack(point)[0], starts)]
    costs = [plain_cost(problem, p, gain) for p in tries] or [np.inf]
    best = tries[int(np.argmin(costs))] if np.isfinite(min(costs)) else start
    return descend(problem, best, gain=gain, evaluations=8)


def imitated(giver: Candidate, point: Array, taker: Candidate, most: int = 1) -> list[Array]:
    """Starts of a law from the optimum of another one at the same place.

    All but its own coefficients are those of the giver, its own imitate the giver's
    force along the giver's motion: a law that holds the other as a special case, or is
    one of it, then starts as good as that one.

    Parameters
    ----------
    giver : Candidate
        With an optimum.
    point : ndarray
        That optimum.
    taker : Candidate
        At the same port.
    most : int
        Shapes to return.

    Returns
    -------
    list of ndarray
        The best imitations, empty where either is no force at a port or nothing moves.
    """
    if taker.effect.place != giver.effect.place:
        return []
    if set(taker.effect.fixed) & set(taker.effect.coefficients):
        return []
    if not giver.problem.in_time:
        return _by_names(giver, point, taker, most)
    found = force_along(giver, point)
    if found is None or not found[-1].any():
        return []
    d, v, w, force = found
    theta, starts = giver.problem.unpack(point)
    other = taker.problem
    p, n = giver.fitted.problem.n_theta, giver.fitted.structure.n_states
    full = np.zeros((starts.shape[0], other.n_states))
    full[:, :n] = starts[:, :n]
    tries: list[tuple[float, Array]] = []
    for shape in _shapes(giver, theta, taker, float(np.sqrt(np.mean(d**2)))):
        columns = unit_forces(
            taker.effect, d, v, [shape], w, resting(taker.fitted.structure, taker.effect.place)
        )
        if columns is None:
            return []
        free = [name for name in taker.effect.free if name not in shape]
        F = np.array(columns).T
        if F.shape[1] != len(free):
            return []
        levels = np.linalg.lstsq(F, force, rcond=1e-10)[0]
        values = {**dict(zip(free, levels, strict=True)), **shape}
        own = np.concatenate([theta[:p], [values[name] for name in taker.effect.free]])
        rest = float(np.sum((force - F @ levels) ** 2))
        tries.append((rest, other.inside(other.pack(own, full))))
    return [start for _, start in sorted(tries, key=lambda pair: pair[0])[:most]]


def _by_names(giver: Candidate, point: Array, taker: Candidate, most: int) -> list[Array]:
    """Starts of a law with the coefficients that it shares with another one, by their names."""
    theta, p = giver.problem.unpack(point)[0], giver.fitted.problem.n_theta
    given = dict(zip([q.name for q in giver.problem.structure.parameters[p:]], theta[p:], strict=True))
    names = [q.name for q in taker.problem.structure.parameters[p:]]
    if not set(names) & given.keys():
        return []
    found = []
    for start in taker.starts[:most]:
        own = [given.get(name, value) for name, value in zip(names, start[p:], strict=True)]
        found.append(taker.problem.inside(np.concatenate([theta[:p], own])))
    return found


def force_along(candidate: Candidate, point: Array) -> tuple[Array, Array, Array, Array] | None:
    """Force of a candidate at a point, along the motion that it then has.

    Parameters
    ----------
    candidate : Candidate
    point : ndarray
        Of its problem.

    Returns
    -------
    d, v : ndarray, shape (N,)
        Displacement and velocity at its port, all records one after the other.
    w : ndarray, shape (n_w, N)
        Inputs.
    force : ndarray, shape (N,)
        None in place of all where it is no force at a port, or no number.
    """
    problem, effect = candidate.problem, candidate.effect
    structure = problem.structure
    if not problem.in_time:
        return None
    port = next((port for port in structure.model.ports if port.name == effect.place), None)
    own = len(structure.effects) - 1
    at_port = bool(structure.port_effects) and structure.port_effects[-1] == own
    if port is None or not (effect.spec.is_element or at_port):
        return None
    theta, starts = problem.unpack(point)
    rows: list[tuple[Array, ...]] = []
    for engine, start in zip(problem.engines, starts, strict=True):
        run = engine.run(theta, start, sensitivity=False, histories=True, check=False)
        w = engine.data.inputs
        d, v = sensed(structure.model, port.name, run.states, w)
        if at_port:
            (d0, v0), rest = resting(structure, port.name) or (0.0, 0.0), tangents(structure, theta)[-1]
            rows.append((d, v, w, run.forces[structure.n_ports - 1] - rest @ [v**0, d - d0, v - v0]))
        else:
            unit = unit_forces(effect, d, v, [], rest=resting(structure, effect.place))
            if unit is None:
                return None
            rows.append((d, v, w, theta[-1] * unit[0]))
    d, v, w, force = (np.concatenate(parts, axis=-1) for parts in zip(*rows, strict=True))
    return (d, v, w, force) if np.isfinite([d, v, force]).all() else None


def _shapes(giver: Candidate, theta: Array, taker: Candidate, rms: float) -> Iterator[dict[str, float]]:
    """What shapes the law: each start's values, those of the giver, those that make it another law."""
    p = taker.fitted.problem.n_theta
    own = [q.name for q in taker.problem.structure.parameters[p:]]
    given = dict(zip([q.name for q in giver.problem.structure.parameters[p:]], theta[p:], strict=True))
    law, other = taker.effect.spec, giver.effect.spec
    same = {name: float(given[name]) for name in other.shaping if name in given}
    for start in taker.starts:
        shape = {name: float(start[p + own.index(name)]) for name in own if name in law.shaping}
        yield shape
        if other.name in law.contains:
            turned = {**same, **law.contains[other.name]}
            yield {name: turned.get(name, value) for name, value in shape.items()}
        for name in shape:
            for share in _LIMITS.get(name, ()):
                yield {**shape, name: share * rms}
