"""A record in blocks: what the engine carries over their borders."""

import control as ct
import numpy as np
import pytest

import rcorefine as rco
from rcorefine import Effect
from rcorefine.data.measurement import block_of_stream
from rcorefine.engine.engine import Engine
from rcorefine.engine.observer import observer_gain
from rcorefine.engine.structure import Structure

DT, N, PAST = 0.02, 400, 60
PLANT = rco.mass_spring_damper([1.0, 0.8], [0.6, 0.5], [90.0, 60.0])
CASES = {
    "linear": [Effect("stiffness", "link1"), Effect("damping", "link2")],
    "cubic": [Effect("cubic_stiffness", "link2")],
    "input delay": [Effect("input_delay", "force1")],
    "dead zone": [Effect("input_deadzone", "force1"), Effect("stiffness", "link2")],
    "rate limit": [Effect("input_rate_limit", "force1")],
    "sensor": [Effect("output_saturation", "mass1")],
}
VALUES = {
    "linear": [-5.0, 0.2], "cubic": [300.0], "input delay": [0.05], "dead zone": [0.1, 4.0],
    "rate limit": [40.0], "sensor": [0.02],
}  # fmt: skip


def names(model):
    linear = model.system
    return dict(zip(("force1", "mass1"), (linear.input_labels[0], linear.output_labels[0]), strict=True))


def structure_of(case):
    known = names(PLANT)
    return Structure(PLANT, [Effect(e.kind, known.get(e.place, e.place)) for e in CASES[case]])


@pytest.mark.parametrize("led", [False, True], ids=["free run", "observer"])
@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("case", CASES)
def test_blocks_give_what_the_whole_record_gives(case, hold, led):
    """A block begins at the last sample of the one before, with its state and the derivatives."""
    s, theta = structure_of(case), np.array(VALUES[case])
    rng = np.random.default_rng(3)
    w = np.repeat(rng.standard_normal((s.n_inputs, N // 4)), 4, axis=1)
    y = 0.01 * rng.standard_normal((s.n_outputs, N))
    data = rco.Measurement(w, y, dt=DT, hold=hold)
    gain = observer_gain(s, theta, data, 0.1, at="inputs") if led else None
    whole = Engine(s, data, substeps=4).run(theta, gain=gain, initial_state=True)
    n, p = s.n_states, s.n_parameters
    x, inner, S = np.zeros(n), None, np.vstack([np.zeros((p, n)), np.eye(n)])
    for first in range(0, N - 1, 40):
        last = min(first + 40, N - 1)
        block = rco.Measurement(
            w[:, first : last + 1], y[:, first : last + 1], dt=DT, hold=hold, elapsed=first * DT
        )
        engine = Engine(s, block, substeps=4, past=w[:, max(first - PAST, 0) : first])
        use = np.ones(block.outputs.T.shape, dtype=bool)
        use[0] = first == 0  # the sample that both blocks have corrects once
        run = engine.run(theta, x, gain=gain, use=use, inner=inner, initial_state=True)
        at = slice(1, None) if first else slice(None)
        judged = slice(first + (first > 0), last + 1)
        assert run.outputs[:, at] == pytest.approx(whole.outputs[:, judged], rel=1e-9, abs=1e-12)
        # chain rule: by the coefficients directly, and through the state at the start of the block
        found = run.sensitivity[:, :, p:] @ S.T
        found[:, :, :p] += run.sensitivity[:, :, :p]
        assert found[:, at] == pytest.approx(whole.sensitivity[:, judged], rel=1e-7, abs=1e-9)
        x, inner = run.last.x, run.last.z
        S = S @ run.last.S[p:] + np.vstack([run.last.S[:p], np.zeros((n, n))])


def test_a_delay_knows_the_inputs_before_a_block():
    """Samples that only inputs of the past explain are judged; without them they are not."""
    s = structure_of("input delay")
    w = np.ones((s.n_inputs, 100))
    block = rco.Measurement(w, np.zeros((s.n_outputs, 100)), dt=DT, elapsed=5.0)
    theta = np.array([0.05])  # two and a half samples
    assert Engine(s, block, past=w[:, :3]).judged(theta).all()
    assert not Engine(s, block, past=w[:, :1]).judged(theta)[:, :2].any()
    assert not Engine(s, block).judged(theta)[:, :3].any()


def test_a_block_may_have_fewer_samples_than_signals():
    """As a record it would be refused as transposed; a monitor of three outputs stopped there."""
    plant = rco.mass_spring_damper([1.0, 1.0, 1.0], [0.5] * 3, [100.0, 90.0, 80.0])
    s = Structure(plant, [Effect("stiffness", "link1")])
    w = np.random.default_rng(1).standard_normal((s.n_inputs, 2))
    block = block_of_stream(w, np.zeros((3, 2)), DT, "zoh")
    found = Engine(s, block).run(np.array([5.0])).outputs
    longer = rco.Measurement(np.pad(w, ((0, 0), (0, 8))), np.zeros((3, 10)), dt=DT)
    assert found == pytest.approx(Engine(s, longer).run(np.array([5.0])).outputs[:, :2], rel=1e-12)
    with pytest.raises(ct.ControlDimension, match="transposed"):
        rco.Measurement(w, np.zeros((3, 2)), dt=DT)
