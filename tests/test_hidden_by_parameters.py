"""Effects that wrong parameters, open shapes and several small delays hide from the first look."""

import pytest
from hidden.coursework import coursework

import rcorefine as rco
from rcorefine.diagnosis import search


@pytest.mark.slow
@pytest.mark.parametrize("seed", [52026, 52033])
def test_what_is_hidden_beside_parameters_is_named(seed):
    """A delay beside wrong R and L; a lag and friction, which a delay, a smoothing and Stribeck imitate."""
    record = coursework(seed)
    found = rco.diagnose(record.model, record.data)
    rows = [row for r in found.ranking if r.alike for row in (r, *r.same)]
    (row, *_) = [row for row in rows if {e.kind for e in row.effects} == {one.kind for one in record.hidden}]
    sizes = {effect: values for effect, values in row.estimates}
    for one in record.hidden:
        (effect,) = (effect for effect in row.effects if effect.kind == one.kind)
        for name, true in one.truth(effect.place, record.model).items():
            assert abs(sizes[effect][name].coefficient - true) < 4 * sizes[effect][name].std + 0.05 * abs(
                true
            )


def test_delays_and_lags_of_channels_are_one_group():
    effects = [
        rco.Effect("coulomb_friction", "shaft"),
        rco.Effect("input_delay", "u"),
        rco.Effect("output_smoothing", "y"),
        rco.Effect("output_saturation", "y"),
    ]
    assert [search._is_late(effect) for effect in effects] == [False, True, True, False]
    assert search._groups(effects) == [[0], [1], [2], [3], [2, 3], [1, 2]]
