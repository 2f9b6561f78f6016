"""March over a record in two passes: the motion, then its derivatives.

The first pass integrates the motion and writes on a tape what each step was about: states, inputs, forces,
slopes of the laws. The second pass goes over the tape for eight derivatives at a time. It has no laws to
evaluate and no equations to solve: along a known motion derivatives obey linear recursions. Both passes take
turns, a stretch of the record at a time, so that the tape stays in the cache of the processor.

Where no force jumps or remembers, forces run as parabolas over a step, and are found at its middle and at its
end: collocation by the Lobatto IIIA formula of order 4 (Hairer, Norsett, Wanner, "Solving Ordinary
Differential Equations II", 1996, section IV.5), exact for what is linear. Otherwise they run straight.

numba compiles both passes where it is installed; without it the same source runs as plain Python.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..effects.compiled import COUNT, evaluate
from ..jit import NUMBA, by_address, compiled, inlined, put, put_rows
from ..systems.linear import Array
from .inputs import Drive
from .linear import Corrections, Substep
from .products import add, add_each, add_product, apply, clear, combine, copy, solve_in_place

lanewise = partial(compiled, lanes=True)

_LANES = 8  # derivatives at a time where compiled; in Python all of them
_STRETCH = 2048  # events on a tape that stays in the cache
_FORCES, _OUTPUTS, _RESET = -1, -2, -3  # events at a sample; others are steps, by their grade
_OUTSIDE = 2e-5  # share of `far` within which the residual of an equation may be rounding, as at rest
_NO_FORCES = 1e-6  # relative squared residual of an equation that has no solution
# flags: forces are outdated, none known yet, an output is large, parameters of the field are free
_STALE, _FIRST, _FAR, _NUMBERS = 0, 1, 2, 3


class PortLaws(NamedTuple):
    """Force laws at m places.

    Attributes
    ----------
    codes : ndarray of int, shape (m,)
        Laws, as `evaluate` takes them.
    values : ndarray, shape (m, 7)
        Coefficients; 1 where the law feels the inputs, where it jumps, where it remembers.
    columns : ndarray of int, shape (m, 4)
        Rows of the coefficients in the sensitivity, -1 where fixed.
    widths : ndarray, shape (m,)
        Widths over which jumps are smoothed.
    """

    codes: NDArray[np.int64]
    values: Array
    columns: NDArray[np.int64]
    widths: Array


class SensorLaws(NamedTuple):
    """Laws of the outputs, 0 for none; see `PortLaws`."""

    codes: NDArray[np.int64]
    values: Array
    columns: NDArray[np.int64]


class FieldLaw(NamedTuple):
    """Nonlinear right-hand side: code, parameters (1, q), their columns."""

    code: int
    values: Array
    columns: NDArray[np.int64]


class Discretized(NamedTuple):
    """A model with laws, over a substep."""

    at: Substep
    ports: PortLaws
    sensors: SensorLaws
    field: FieldLaw


class MarchState(NamedTuple):
    """State of the march, changed in place.

    Attributes
    ----------
    x : ndarray, shape (n,)
        State.
    z : ndarray, shape (m,), (m + n_y,) or (m + 2 n_y,)
        Inner states of the laws, those of outputs behind, and the outputs before (nan at first).
    S : ndarray, shape (p, n)
        Sensitivity of the state; p = 0 for none.
    """

    x: Array
    z: Array
    S: Array


class MarchResult(NamedTuple):
    """Room for what the march finds, and where it stops.

    Attributes
    ----------
    outputs : ndarray, shape (N, n_y)
    sensitivity : ndarray, shape (N, n_y, p)
    states : ndarray, shape (N or 0, n)
        After the correction.
    forces : ndarray, shape (N or 0, m)
    far : ndarray, shape (n_y,)
        Stop where an output exceeds this.
    limit : float
        Stop where a state exceeds this.
    substeps : int
        Substeps per sample.
    """

    outputs: Array
    sensitivity: Array
    states: Array
    forces: Array
    far: Array
    limit: float
    substeps: int


class _Room(NamedTuple):
    """Tape of the two passes, and what is known at the last point.

    On the tape stand, one behind the other: state, inputs at both ends of a step and forces; states at its
    points with their inputs; the inverse of the equations of the forces; what the laws write; slopes of the
    field by what it takes, and by its parameters; ends of the piece in its substep; which outputs corrected
    the state; what the laws of the outputs write.

    Attributes
    ----------
    tape : ndarray, shape (events, width)
    what : ndarray of int, shape (events, 3)
        Sort of event; sample, or row of the inputs before; row after, or whether it is the first.
    places : ndarray of int, shape (9,)
        Where each of these begins; last, the width.
    flags : ndarray of bool, shape (4,)
        Forces to be found again, none known yet, an output is far off, parameters of the field are free.
    Q : ndarray, shape (grades, stages (2 m + n_s), unknown)
        What the forces of a step add to what is felt.
    f : ndarray, shape (forces,)
    last : ndarray, shape (2, m)
        What places felt before.
    past : ndarray, shape (2, n_y)
        Outputs before, and what their laws keep of them.
    table : ndarray, shape (stages, n_f (2 + n_s + q))
        What the field writes.
    ends : ndarray of int, shape (2,)
        Next sample, and the first that blew up, or -1.
    """

    tape: Array
    what: NDArray[np.int64]
    places: NDArray[np.int64]
    flags: NDArray[np.bool_]
    Q: Array
    f: Array
    last: Array
    past: Array
    table: Array
    ends: NDArray[np.int64]


@lanewise
def _stages_of(model, n, nw):
    """Return at how many points of a step forces are found.

    It is its end, or its middle and its end.
    """
    forces = model.at.O.shape[1] - n - nw
    return (model.at.M.shape[2] - n - 2 * nw) // forces - 1 if forces > 0 else 1


@lanewise
def _room_for(model, course, samples, substeps):
    """Return room for a march.

    The tape holds a stretch of the record, or one event where there are no derivatives.
    """
    at, ports, sensors, field = model
    n, m, ny, grades, felt = (
        course.x.shape[0],
        ports.codes.shape[0],
        at.O.shape[0],
        at.M.shape[0],
        at.P.shape[0],
    )
    nw = at.P.shape[1] - n
    forces, stages = at.O.shape[1] - n - nw, _stages_of(model, n, nw)
    unknown, ns, nf, q = stages * forces, felt - 2 * m, forces - m, field.columns.shape[0]
    sensed = False
    for i in range(ny):
        sensed = sensed or sensors.codes[i] != 0
    # first column of each block of an event on the tape, in the order of `_Room`
    places = np.zeros(10, dtype=np.int64)
    places[1] = at.M.shape[2]
    places[2] = places[1] + stages * (n + nw)
    places[3] = places[2] + unknown * unknown
    places[4] = places[3] + stages * m * (COUNT + nw - 1)
    places[5] = places[4] + stages * nf * ns
    places[6] = places[5] + stages * nf * q
    places[7] = places[6] + 2
    places[8] = places[7] + ny
    places[9] = places[8] + (ny * (COUNT + nw - 1) if sensed else 0)
    # at least the events of one sample with all its pieces; at most a stretch of the record
    events = 1
    if course.S.shape[0] > 0:
        events = (4 + (substeps << 2 * (grades - 1))) + min(samples * (3 + substeps), _STRETCH)
    flags = np.zeros(4, dtype=np.bool_)
    flags[_STALE] = flags[_FIRST] = True
    for c in range(q):
        flags[_NUMBERS] = flags[_NUMBERS] or field.columns[c] >= 0
    # Q = P M_f: motion felt at the points of a step per unit of the unknown forces
    Q = np.zeros((grades, stages * felt, unknown))
    for grade in range(grades):
        for i in range(stages * felt):
            for j in range(unknown):
                for l in range(n):
                    by = at.M[grade, (i // felt) * n + l, n + 2 * nw + forces + j]
                    Q[grade, i, j] += at.P[i % felt, l] * by
    past = np.full((2, ny), np.nan)  # the outputs before the first sample are unknown
    for i in range(ny):
        past[1, i] = course.z[m + i] if course.z.shape[0] > m else 0.0
        if course.z.shape[0] > m + ny:
            past[0, i] = course.z[m + ny + i]
    return _Room(
        np.zeros((events, places[9])), np.zeros((events, 3), dtype=np.int64), places, flags, Q,
        np.zeros(forces), np.zeros((2, m)), past, np.zeros((stages, nf * (2 + ns + q))),
        np.zeros(2, dtype=np.int64),
    )  # fmt: skip


@lanewise
def _repeated(rows, times):
    """Repeat a matrix below itself."""
    found = np.zeros((times * rows.shape[0], rows.shape[1]))
    for i in range(times):
        put_rows(found[i * rows.shape[0] :], rows)
    return found


@lanewise
def _jacobian(J, parts, table, Q, row, m, ns):
    """Compute the Jacobian of the equations for the forces.

    Each force equals that of its law, or of its row of the field.
    """
    stages, unknown = table.shape[0], J.shape[0]
    forces = unknown // stages
    wide = table.shape[1] // max(forces - m, 1)
    for r in range(unknown):
        stage, i = r // forces, r % forces
        felt = row + stage * (2 * m + ns)
        for j in range(unknown):
            total = 0.0
            # force law: I - (df/dd Q_d + df/dv Q_v)
            if i < m:
                at = stage * m + i
                total = parts[at, 1] * Q[felt + i, j] + parts[at, 2] * Q[felt + m + i, j]
            else:
                # row of the field: I - df/dx Q_x
                for k in range(ns):
                    total += table[stage, (i - m) * wide + 2 + k] * Q[felt + 2 * m + k, j]
            J[r, j] = (1.0 if r == j else 0.0) - total


@lanewise
def _write(row, places, parts, table, nf, ns):
    """Write the slopes of laws and field on the tape."""
    count, rows = parts.shape[1], table.shape[0] * nf
    for i in range(parts.shape[0]):
        for c in range(count):
            row[places[3] + i * count + c] = parts[i, c]
    q = (places[6] - places[5]) // max(rows, 1)
    for i in range(rows):
        first = (i % nf) * (2 + ns + q) + 2
        for j in range(ns):
            row[places[4] + i * ns + j] = table[i // nf, first + j]
        for j in range(q):
            row[places[5] + i * q + j] = table[i // nf, first + ns + j]


@lanewise
def _integrate(model, drive, observer, course, into, room, begin):
    """Integrate the motion from a sample on until the tape is full.

    Return the events on the tape; `room.ends` takes the next sample, and the first that blew up, or -1.
    """
    at, ports, sensors, field = model
    x, z, Wout, W, tape, what, flags = (
        course.x,
        course.z,
        drive.Wout,
        drive.W,
        room.tape,
        room.what,
        room.flags,
    )
    f, last, past, table, places = room.f, room.last, room.past, room.table, room.places
    O, P, K, reset, widths = at.O, at.P, observer.gain, observer.reset, ports.widths
    use, measured, outputs, far, substeps = (
        observer.use,
        observer.measured,
        into.outputs,
        into.far,
        into.substeps,
    )
    # sizes: n states, m places, n_y outputs, grades of smaller steps, N samples, n_w inputs
    n, m, ny, grades, samples = x.shape[0], ports.codes.shape[0], O.shape[0], at.M.shape[0], Wout.shape[0]
    nw = P.shape[1] - n
    stages, forces, count = table.shape[0], f.shape[0], COUNT + nw - 1
    felt, nf, unknown, steps = P.shape[0], forces - m, stages * forces, at.M.shape[2]
    ns, wide = felt - 2 * m, table.shape[1] // max(nf, 1)
    ends, ticks = n + 2 * nw + forces, 1 << 2 * (grades - 1)  # ticks: smallest pieces of a substep
    keep = 1 if course.S.shape[0] > 0 else 0
    remembers, by_slopes = z.shape[0] > m, 2.0 if flags[_NUMBERS] else 1.0
    # forces are found anew at each sample only where a place feels the inputs
    senses_inputs = False
    for i in range(felt):
        for j in range(n, n + nw):
            senses_inputs = senses_inputs or P[i, j] != 0.0
    for i in range(m):
        senses_inputs = senses_inputs or ports.values[i, 4] != 0.0
    # one copy of the coefficients for each point of a step
    values, numbers = _repeated(ports.values, stages), _repeated(field.values, stages)
    Ms = at.M.copy().reshape(grades * stages * n, steps)
    Qs = room.Q.reshape(grades * stages * felt, unknown)
    parts, shown, J = np.zeros((stages * m, count)), np.zeros((ny, count)), np.zeros((unknown, unknown))
    inverse, newton, own, w = J.copy(), np.zeros((1, unknown)), np.zeros(ns), np.ones(nw)
    move = np.zeros(unknown)
    step, xs, free, sense = (
        np.zeros(steps),
        np.zeros(stages * n),
        np.zeros(stages * felt),
        np.zeros(stages * felt),
    )
    trial, base, w_law = np.zeros(unknown), np.zeros(unknown), w[: nw - 1]
    alone = unknown == 1 and m == 1
    # events that one sample can write; the loop stops where the tape may overflow
    most, t = keep * (4 + substeps * ticks), 0
    k, blew_up = begin, -1
    while k < samples and blew_up < 0 and t + most <= tape.shape[0]:
        # controller in the loop: its states jump at the sample
        if reset.shape[0] > 0:
            put(xs, 0, x)
            apply(x, reset, xs, 0, 0)
            what[t, 0] = _RESET
            t += keep
        # forces before the outputs, and once more after the correction of the state
        for attempt in range(2):
            # forces at the sample: new where the state was corrected, or a place feels the inputs
            if forces > 0 and (flags[_STALE] or (senses_inputs and attempt == 0)):
                put(step, 0, x)
                put(step, n, Wout[k])
                put(w, 0, Wout[k])
                # what the places feel: d, v and the arguments of the field
                apply(sense[:felt], P, step, 0, 0)
                at_last = (stages - 1) * m
                for i in range(m):
                    if flags[_FIRST]:
                        last[0, i] = sense[i]
                    evaluate(
                        ports.codes[i], sense[i], sense[m + i], last[0, i], z[i], values, at_last + i,
                        widths[i], w_law, parts,
                    )  # fmt: skip
                    f[i], z[i] = parts[at_last + i, 0], parts[at_last + i, 5]
                    last[0, i], last[1, i] = sense[i], sense[m + i]
                # nonlinear right-hand side at the sample
                if nf > 0:
                    put(own, 0, sense[2 * m : felt])
                    wanted = by_slopes if keep or flags[_FIRST] else 0.0
                    for stage in range(stages if flags[_FIRST] else 1):
                        evaluate(field.code, 0.0, 0.0, 0.0, 0.0, numbers, stage, wanted, own, table)
                    for i in range(nf):
                        f[m + i] = table[0, i * wide]
                # tape: state, inputs and slopes of the laws
                if keep:
                    put(tape[t], 0, step[: n + nw])
                    _write(tape[t], places, parts, table, nf, ns)
                    what[t, 0], what[t, 1], what[t, 2] = _FORCES, k, flags[_FIRST]
                    t += 1
                flags[_STALE] = flags[_FIRST] = False
            if attempt == 1:
                break
            # outputs, by the sensors' own laws, and the correction of the state by them
            put(step, 0, x)
            put(step, n, Wout[k])
            put(step, n + nw, f)
            apply(outputs[k], O, step, 0, 0)
            if keep:
                put(tape[t], 0, step[: n + nw + forces])
                what[t, 0], what[t, 1] = _OUTPUTS, k
            if into.forces.shape[0] > 0:
                put(into.forces[k], 0, f)
            # each output: law of the sensor, bounds, correction
            for i in range(ny):
                y, slope = outputs[k, i], 1.0
                if sensors.codes[i] != 0:
                    if np.isnan(past[0, i]):
                        past[0, i] = y
                    put(w, 0, Wout[k])
                    evaluate(
                        sensors.codes[i], y, 0.0, past[0, i], past[1, i], sensors.values, i, 1.0, w_law, shown
                    )
                    if remembers:  # memory of the sensor's law
                        past[0, i], past[1, i] = y, shown[i, 5]
                        z[m + i] = shown[i, 5]
                        if z.shape[0] > m + ny:
                            z[m + ny + i] = y
                    y, slope = shown[i, 0], shown[i, 1]
                    shown[i, 2] = shown[i, 17] = 0.0  # no derivative by the flag for held signals
                    outputs[k, i] = y
                    if keep:
                        put(tape[t], places[8] + i * count, shown[i])
                # the motion has run away
                if not abs(y) <= far[i]:
                    blew_up = k
                    break
                if use[k, i] == 2:  # a controller takes what the sensor shows
                    slope = 1.0
                flags[_FAR] = (flags[_FAR] and i > 0) or abs(y) > _OUTSIDE * far[i]
                corrects = use[k, i] != 0 and slope != 0.0
                if keep:
                    tape[t, places[7] + i] = slope if corrects else 0.0
                # observer: x += K slope (y_measured - y)
                if corrects:
                    flags[_STALE] = True
                    for j in range(n):
                        x[j] += K[j, i] * slope * (measured[k, i] - y)
            if blew_up >= 0:
                break
            if into.states.shape[0] > 0:
                put(into.states[k], 0, x)
            t += keep
        # substeps up to the next sample
        for s in range(substeps if k < samples - 1 and blew_up < 0 else 0):
            row = (k * substeps + s) * max(drive.course, 1)
            after = row + min(drive.course, 1)
            grade, length, tick = 0, ticks, 0
            # pieces of a substep, smaller where a friction force jumps
            while tick < ticks:
                early, late = tick / ticks, (tick + length) / ticks
                put(step, 0, x)
                # inputs at both ends of the piece, straight over the substep
                for j in range(nw):
                    rise = W[after, j] - W[row, j]
                    step[n + j], step[n + nw + j] = W[row, j] + early * rise, W[row, j] + late * rise
                put(step, n + 2 * nw, f)
                for j in range(ends, steps):
                    step[j] = 0.0
                # motion at the points of the step without the unknown forces
                apply(xs, Ms, step, grade * stages * n, 0)
                level, best, scale = 0.0, np.inf, 1.0
                if forces > 0:
                    # what is felt without them
                    for stage in range(stages):
                        for i in range(felt):
                            total, share = 0.0, (stage + 1) / stages
                            for j in range(n):
                                total += P[i, j] * xs[stage * n + j]
                            for j in range(nw):
                                total += P[i, n + j] * (
                                    step[n + j] + share * (step[n + nw + j] - step[n + j])
                                )
                            free[stage * felt + i] = total
                    for i in range(unknown):
                        trial[i] = f[i % forces]
                    for iteration in range(60):  # forces by damped Newton steps from the last ones
                        put(sense, 0, free)
                        add(sense, Qs, trial, grade * stages * felt, 0)
                        # residual: forces minus those of the laws at the motion they cause
                        size, level = 0.0, 0.0
                        for stage in range(stages):
                            here, share = stage * felt, (stage + 1) / stages
                            if senses_inputs:
                                for j in range(nw):
                                    w[j] = step[n + j] + share * (step[n + nw + j] - step[n + j])
                            for i in range(m):
                                r = stage * m + i
                                evaluate(
                                    ports.codes[i], sense[here + i], sense[here + m + i], last[0, i], z[i],
                                    values, r, widths[i], w_law, parts,
                                )  # fmt: skip
                                newton[0, stage * forces + i] = trial[stage * forces + i] - parts[r, 0]
                                level = max(level, abs(parts[r, 0]))
                            if nf > 0:
                                put(own, 0, sense[here + 2 * m : here + felt])
                                # Newton steps reuse the slopes of the field; every fourth renews them
                                wanted = 1.0 if iteration % 4 == 3 else 0.0
                                evaluate(field.code, 0.0, 0.0, 0.0, 0.0, numbers, stage, wanted, own, table)
                                for i in range(nf):
                                    r = stage * forces + m + i
                                    newton[0, r] = trial[r] - table[stage, i * wide]
                                    level = max(level, table[stage, i * wide + 1])
                        for i in range(unknown):
                            size += newton[0, i] * newton[0, i]
                        # damping: halve the step where the residual increased
                        if size >= best and scale > 1e-6 and iteration > 0:
                            scale *= 0.5
                            for i in range(unknown):
                                trial[i] = base[i] - scale * move[i]
                            continue
                        best = size
                        if size <= 1e-20 * (level * level + 1e-300) or not np.isfinite(size):
                            break
                        # Newton step: solve J move = residual
                        if alone:
                            newton[0, 0] /= (
                                1.0 - parts[0, 1] * Qs[grade * 2, 0] - parts[0, 2] * Qs[grade * 2 + 1, 0]
                            )
                        else:
                            _jacobian(J, parts, table, Qs, grade * stages * felt, m, ns)
                            solve_in_place(J, newton)
                        scale = 1.0
                        for i in range(unknown):
                            base[i], move[i] = trial[i], newton[0, i]
                            trial[i] = base[i] - move[i]
                    # no forces solve the equations: the motion has run away within the step
                    if nf > 0 and flags[_FAR] and not best <= _NO_FORCES * (level * level + 1e-300):
                        blew_up = k + 1
                        break
                    # what is felt with the forces found
                    put(sense, 0, free)
                    add(sense, Qs, trial, grade * stages * felt, 0)
                    if length > 1:  # a friction force jumps inside: repeat with the first quarter
                        jumps = False
                        for i in range(m):
                            if ports.values[i, 5] != 0.0:
                                v, before, stuck = sense[m + i], last[1, i], 3.0 * widths[i]
                                moves, moved = abs(v) > stuck, abs(before) > stuck
                                jumps = jumps or ((moves or moved) and (moves != moved or v * before < 0.0))
                        if jumps:
                            grade += 1
                            length //= 4
                            continue
                    # motion with the forces found
                    put(step, ends, trial)
                    add(xs, Ms, trial, grade * stages * n, ends)
                # tape: what the derivatives of this step need
                if keep:
                    put(tape[t], 0, step)
                    what[t, 0], what[t, 1], what[t, 2] = grade, row, after
                    tape[t, places[6]], tape[t, places[6] + 1] = early, late
                if keep and forces > 0:
                    for stage in range(stages):
                        share, here = (stage + 1) / stages, places[1] + stage * (n + nw)
                        put(tape[t], here, xs[stage * n : (stage + 1) * n])
                        for j in range(nw):
                            tape[t, here + n + j] = step[n + j] + share * (step[n + nw + j] - step[n + j])
                        if nf > 0:  # slopes at the solution, not those of the last Newton step
                            put(own, 0, sense[stage * felt + 2 * m : (stage + 1) * felt])
                            evaluate(field.code, 0.0, 0.0, 0.0, 0.0, numbers, stage, by_slopes, own, table)
                    # df = J^-1 (change of the laws at fixed forces), by the implicit function theorem
                    _jacobian(J, parts, table, Qs, grade * stages * felt, m, ns)
                    clear(inverse, 0, unknown)
                    for i in range(unknown):
                        inverse[i, i] = 1.0
                    solve_in_place(J, inverse)
                    for i in range(unknown):
                        for j in range(unknown):
                            tape[t, places[2] + i * unknown + j] = inverse[j, i]
                    _write(tape[t], places, parts, table, nf, ns)
                # end of the step: state, forces, inner states of the laws
                put(x, 0, xs[(stages - 1) * n :])
                put(f, 0, trial[unknown - forces :])
                for i in range(m):
                    z[i] = parts[(stages - 1) * m + i, 5]
                    last[0, i] = sense[(stages - 1) * felt + i]
                    last[1, i] = sense[(stages - 1) * felt + m + i]
                t += keep
                tick += length
                # back to larger pieces where they start on their grid
                while length < ticks and tick % (4 * length) == 0:
                    length *= 4
                    grade -= 1
            if blew_up >= 0:
                break
        # a state beyond all bounds
        for j in range(n if k < samples - 1 and blew_up < 0 else 0):
            if not abs(x[j]) < into.limit:
                blew_up = k + 1
        k += 1
    room.ends[0], room.ends[1] = k, blew_up
    return t


class _Lanes(NamedTuple):
    """Derivatives, eight at a time (in Python all of them).

    Attributes
    ----------
    order : ndarray of int, shape (blocks, lanes)
        Rows of the sensitivity, those first that the matrices depend on; -1 for none.
    kept : ndarray, shape (blocks, rows, lanes)
        Derivatives of what the march keeps: state, forces, inner states and displacements, past outputs; and
        room for those of a step.
    dM, dO, dP : ndarray
        Derivatives of the matrices, those of all blocks below each other, lanes innermost.
    """

    order: NDArray[np.int64]
    kept: Array
    dM: Array
    dO: Array
    dP: Array


@lanewise
def _enter_rows(into, values, row, lane):
    """Write a matrix into a lane, from a row on."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            into[row + i, j, lane] = values[i, j]


@lanewise
def _lanes_for(model, course):
    """Arrange derivatives in lanes."""
    at, p, q, n = model.at, course.S.shape[0], model.at.linear.shape[0], course.x.shape[0]
    m, ny, felt, nw = model.ports.codes.shape[0], at.O.shape[0], at.P.shape[0], at.P.shape[1] - n
    lanes, forces = _LANES if NUMBA else max(p, 1), at.O.shape[1] - n - nw
    stages = _stages_of(model, n, nw)
    blocks, forced = -(-p // lanes), -(-q // lanes)
    # parameters that change the matrices first, then the others
    order, absorbed, rest = np.full(blocks * lanes, -1, dtype=np.int64), np.zeros(p, dtype=np.bool_), q
    for r in range(q):
        order[r], absorbed[at.linear[r]] = at.linear[r], True
    for c in range(p):
        if not absorbed[c]:
            order[rest] = c
            rest += 1
    order = order.reshape(blocks, lanes)
    rows = n + forces + 2 * m + 2 * ny + stages * (n + felt + 2 * forces) + ny + 3 * nw
    kept = np.zeros((blocks, rows, lanes))
    for i in range(p):
        for j in range(n):
            kept[i // lanes, j, i % lanes] = course.S[order[i // lanes, i % lanes], j]
    grades, high, wide = at.M.shape
    dM = np.zeros((forced * grades * high, wide, lanes))
    # derivatives of the matrices, lane by lane
    dO, dP = np.zeros((forced * ny, at.O.shape[1], lanes)), np.zeros((forced * felt, n + nw, lanes))
    for r in range(q):
        b, l = r // lanes, r % lanes
        for grade in range(grades):
            _enter_rows(dM, at.dM[grade, r], (b * grades + grade) * high, l)
        _enter_rows(dO, at.dO[r], b * ny, l)
        if at.dP.shape[0] > 0:
            _enter_rows(dP, at.dP[r], b * felt, l)
    return _Lanes(order, kept, dM, dO, dP)


@lanewise
def _enter(L, to, dW, row, lane, share):
    """Add a share of the derivatives of the inputs to lanes from `to` on."""
    for r in range(lane.shape[0]):
        if lane[r] >= 0:
            for j in range(dW.shape[2]):
                L[to + j, lane[r]] += share * dW[r, row, j]


@inlined
def _law(L, to, felt, kept, tape, at, lane, i):
    """Compute the derivatives of a force.

    It depends on what its place feels, on what its law remembers, and on coefficients.
    """
    combine(
        L, to, (felt[0], felt[1], kept[1], kept[0]), (tape[at + 1], tape[at + 2], tape[at + 3], tape[at + 4])
    )
    for c in range(4):
        if lane[i, c] >= 0:
            L[to, lane[i, c]] += tape[at + 9 + c]


@inlined
def _remember(L, felt, kept, tape, at, lane, i):
    """Compute the derivatives of what a law remembers.

    These are its inner state, and what it felt.
    """
    by = (tape[at + 6], tape[at + 17], tape[at + 7], tape[at + 8])
    combine(L, kept[0], (felt[0], felt[1], kept[1], kept[0]), by)
    for c in range(4):
        if lane[i, c] >= 0:
            L[kept[0], lane[i, c]] += tape[at + 13 + c]
    copy(L, kept[1], felt[0], 1)


@inlined
def _enter_numbers(L, to, rows, tape, at, lane):
    """Add the derivatives of the field by its own parameters."""
    for c in range(lane.shape[0]):
        if lane[c] >= 0:
            for i in range(rows):
                L[to + i, lane[c]] += tape[at + i * lane.shape[0] + c]


@lanewise
def _flat(M):
    """Return a matrix as one row."""
    return M.reshape(M.size)


@lanewise
def _lanes_of(where, columns):
    """Return the lanes of coefficients, -1 for those of other blocks."""
    found = np.zeros(columns.shape, dtype=np.int64)
    for i in range(columns.shape[0]):
        for c in range(columns.shape[1]):
            found[i, c] = where[columns[i, c]]
    return found


@lanewise
def _differentiate(model, drive, observer, into, room, lanes, block, events):
    """Go over the tape with one block of derivatives."""
    at, ports, sensors, field = model
    O, P, Ms, Qs = _flat(at.O), _flat(at.P), _flat(at.M), _flat(room.Q)
    reset, K, places, what = _flat(observer.reset), observer.gain, room.places, room.what
    L, order, SY, feels = lanes.kept[block], lanes.order[block], into.sensitivity, ports.values[:, 4].copy()
    dM, dO, dP, dW, dWout, codes = lanes.dM, lanes.dO, lanes.dP, drive.dW, drive.dWout, sensors.codes
    tape, width = _flat(room.tape), room.tape.shape[1]
    nw, ny, m, forces = drive.Wout.shape[1], at.O.shape[0], ports.codes.shape[0], room.f.shape[0]
    (felt, cols_P), cols_O, grades, stages = at.P.shape, at.O.shape[1], at.M.shape[0], room.table.shape[0]
    n, unknown = cols_P - nw, stages * forces
    ns, nf, q, steps, count = felt - 2 * m, forces - m, field.columns.shape[0], at.M.shape[2], COUNT + nw - 1
    high, last, ends = stages * n, (stages - 1) * n, n + 2 * nw + forces
    to_points, to_inverse, to_parts, to_slopes = places[1], places[2], places[3], places[4]
    to_numbers, to_ends, to_used, to_shown = places[5], places[6], places[7], places[8]
    memory = False  # has a force law an inner state?
    for i in range(m):
        memory = memory or ports.values[i, 6] != 0.0
    # rows of the lanes: state, forces, inner states, displacements, past outputs, what is kept of them ...
    F = n
    Z = F + forces
    D = Z + m
    before = D + m
    inner = before + ny
    # ... and of a step: states and sensed signals at its points, forces of the laws, solved forces, signals
    T = inner + ny
    V = T + stages * n
    G = V + stages * felt
    H = G + unknown
    U = H + unknown
    A = U + ny
    B, C = A + nw, A + 2 * nw
    where = np.full(SY.shape[2] + 1, -1, dtype=np.int64)  # lanes of the derivatives; none of -1
    for l in range(order.shape[0]):
        if order[l] >= 0:
            where[order[l]] = l
    of_ports, of_sensors = _lanes_of(where, ports.columns), _lanes_of(where, sensors.columns)
    of_field, of_drive = where[field.columns], where[drive.driven]
    forced, driven = block * order.shape[0] < at.linear.shape[0], False
    for r in range(of_drive.shape[0]):
        driven = driven or of_drive[r] >= 0
    felt_changes, remembers = forced and at.dP.shape[0] > 0, codes.any()
    for t in range(events):
        sort, first, second, row = what[t, 0], what[t, 1], what[t, 2], t * width
        if sort == _OUTPUTS:
            # outputs: dy = C dx + G df + dO [x; w; f] + D dw
            clear(L, U, ny)
            add_product(L, U, ny, O, 0, cols_O, 0, n)
            add_product(L, U, ny, O, n + nw, cols_O, F, forces)
            if forced:
                add_each(L, U, ny, dO, block * ny, cols_O, tape, row)
            if driven:
                clear(L, A, nw)
                _enter(L, A, dWout, first, of_drive, 1.0)
                add_product(L, U, ny, O, n, cols_O, A, nw)
            # laws of the sensors: chain rule
            for i in range(ny):
                if codes[i] != 0:
                    signal, kept = (U + i, U + i), (inner + i, before + i)
                    if first == 0:
                        copy(L, before + i, U + i, 1)
                    _law(L, C, signal, kept, tape, row + to_shown + i * count, of_sensors, i)
                    if remembers:
                        _remember(L, signal, kept, tape, row + to_shown + i * count, of_sensors, i)
                    copy(L, U + i, C, 1)
            for l in range(order.shape[0]):
                if order[l] >= 0:
                    for i in range(ny):
                        SY[first, i, order[l]] = L[U + i, l]
            # observer: dx -= K slope dy
            for i in range(ny):
                if tape[row + to_used + i] != 0.0:
                    for j in range(n):
                        by = -K[j, i] * tape[row + to_used + i]
                        combine(L, j, (j, U + i, U + i, U + i), (1.0, by, 0.0, 0.0))
        elif sort == _RESET:
            # jump at a sample: dx <- R dx
            clear(L, T, n)
            add_product(L, T, n, reset, 0, n, 0, n)
            copy(L, 0, T, n)
        elif sort == _FORCES:
            # forces at a sample: chain rule through what the places feel, P dx + dP [x; w]
            clear(L, V, felt)
            add_product(L, V, felt, P, 0, cols_P, 0, n)
            if felt_changes:
                add_each(L, V, felt, dP, block * felt, n + nw, tape, row)
            if driven:
                clear(L, A, nw)
                _enter(L, A, dWout, first, of_drive, 1.0)
                add_product(L, V, felt, P, n, cols_P, A, nw)
            if second != 0:
                copy(L, D, V, m)
            for i in range(m):
                part = row + to_parts + ((stages - 1) * m + i) * count
                _law(L, F + i, (V + i, V + m + i), (Z + i, D + i), tape, part, of_ports, i)
                if driven and feels[i] != 0.0:
                    add_product(L, F + i, 1, tape, part + COUNT, nw - 1, A, nw - 1)
                _remember(L, (V + i, V + m + i), (Z + i, D + i), tape, part, of_ports, i)
            if nf > 0:
                clear(L, F + m, nf)
                add_product(L, F + m, nf, tape, row + to_slopes, ns, V + 2 * m, ns)
                _enter_numbers(L, F + m, nf, tape, row + to_numbers, of_field)
        else:
            # step without the change of its forces: M [dx; df] + dM [x; w; f]
            M = sort * high
            clear(L, T, high)
            add_product(L, T, high, Ms, M * steps, steps, 0, n)
            add_product(L, T, high, Ms, M * steps + n + 2 * nw, steps, F, forces)
            if forced:
                add_each(L, T, high, dM, (block * grades + sort) * high, steps, tape, row)
            if driven:
                # derivatives of the inputs at both ends of the piece
                clear(L, A, 2 * nw)
                for end in range(2):
                    share = tape[row + to_ends + end]
                    _enter(L, A + end * nw, dW, first, of_drive, 1.0 - share)
                    _enter(L, A + end * nw, dW, second, of_drive, share)
                add_product(L, T, high, Ms, M * steps + n, steps, A, 2 * nw)
            # change of the laws at the points of the step, at fixed forces
            for stage in range(stages if unknown > 0 else 0):
                v, share = V + stage * felt, (stage + 1) / stages
                clear(L, v, felt)
                add_product(L, v, felt, P, 0, cols_P, T + stage * n, n)
                if driven:
                    for j in range(nw):
                        combine(L, C + j, (A + j, B + j, A, A), (1.0 - share, share, 0.0, 0.0))
                    add_product(L, v, felt, P, n, cols_P, C, nw)
                if felt_changes:
                    add_each(L, v, felt, dP, block * felt, n + nw, tape, row + to_points + stage * (n + nw))
                for i in range(m):
                    part, to = row + to_parts + (stage * m + i) * count, G + stage * forces + i
                    _law(L, to, (v + i, v + m + i), (Z + i, D + i), tape, part, of_ports, i)
                    if driven and feels[i] != 0.0:
                        add_product(L, to, 1, tape, part + COUNT, nw - 1, C, nw - 1)
                if nf > 0:
                    to = G + stage * forces + m
                    clear(L, to, nf)
                    add_product(L, to, nf, tape, row + to_slopes + stage * nf * ns, ns, v + 2 * m, ns)
                    _enter_numbers(L, to, nf, tape, row + to_numbers + stage * nf * q, of_field)
            if unknown > 0:
                # forces that follow, and the state at the end of the step
                v = V + (stages - 1) * felt
                clear(L, H, unknown)
                add_product(L, H, unknown, tape, row + to_inverse, unknown, G, unknown)
                add_product(L, T + last, n, Ms, (M + last) * steps + ends, steps, H, unknown)
                copy(L, F, H + unknown - forces, forces)
            if memory:
                # inner states see the motion with these forces
                add_product(
                    L, v, 2 * m, Qs, ((sort * stages + stages - 1) * felt) * unknown, unknown, H, unknown
                )
                for i in range(m):
                    part = row + to_parts + ((stages - 1) * m + i) * count
                    _remember(L, (v + i, v + m + i), (Z + i, D + i), tape, part, of_ports, i)
            copy(L, 0, T + last, n)


@lanewise
def march(model, drive, observer, course, into):
    """Integrate a record; return the first sample that blew up, or -1.

    Where a field leaves no forces at the end of a step the motion has run away within it.

    Parameters
    ----------
    model : Discretized
        Matrices of a substep, and of its pieces where forces jump; laws.
    drive : Drive
        Inputs.
    observer : Corrections
        What corrects the state at the samples.
    course : MarchState
        State at the first sample; at the last one on return.
    into : MarchResult
        Takes outputs and their derivatives, and says where to stop.
    """
    samples, S = drive.Wout.shape[0], course.S
    room = _room_for(model, course, samples, into.substeps)
    # motion alone
    if S.shape[0] == 0:
        _integrate(model, drive, observer, course, into, room, 0)
        return room.ends[1]
    lanes = _lanes_for(model, course)
    blocks, begin = lanes.order.shape[0], 0
    room.ends[1] = -1
    # a stretch of the record at a time: integrate the motion, then its derivatives
    while begin < samples and room.ends[1] < 0:
        events = _integrate(model, drive, observer, course, into, room, begin)
        begin = room.ends[0]
        for block in range(blocks):
            _differentiate(model, drive, observer, into, room, lanes, block, events)
    # sensitivity at the last sample, in the order of the parameters
    width = lanes.order.shape[1]
    for i in range(S.shape[0]):
        put(S[lanes.order[i // width, i % width]], 0, lanes.kept[i // width, : S.shape[1], i % width])
    return room.ends[1]


def _example() -> tuple[Discretized, Drive, Corrections, MarchState, MarchResult]:
    """Arguments of `march`, for their types."""
    a, b, c, d = (np.zeros((0,) * k) for k in (1, 2, 3, 4))
    i, j = np.zeros(0, dtype=np.int64), np.zeros((0, 0), dtype=np.int64)
    model = Discretized(
        Substep(c, d, i, b, c, b, c), PortLaws(i, b, j, a), SensorLaws(i, b, j), FieldLaw(0, b, i)
    )
    corrections = Corrections(b, np.zeros((0, 0), dtype=np.uint8), b, b)
    return (
        model,
        Drive(b, 0, b, c, c, i),
        corrections,
        MarchState(a, a, b),
        MarchResult(b, c, b, b, a, 0.0, 0),
    )


#: `march` for other kernels by its address; a direct call would compile it again inside of them.
march_at, address_of_march = by_address(march, _example)
