"""The catalogue of kinds and the effects made from it."""

import copy
import itertools
import math
import pickle

import control as ct
import numpy as np
import pytest
from inner import KINDS

import rcorefine as rco
from rcorefine.models.parameters import combine_units

# what the design promises: kind -> (places, coefficients)
TABLE = {
    "stiffness": ("mechanical", ("stiffness",)),
    "damping": ("mechanical first_order", ("damping",)),
    "mass": ("mechanical first_order", ("mass",)),
    "cubic_stiffness": ("mechanical", ("cubic_stiffness",)),
    "quadratic_stiffness": ("mechanical", ("quadratic_stiffness",)),
    "bilinear_stiffness": ("mechanical", ("bilinear_stiffness",)),
    "clearance": ("mechanical", ("stiffness", "gap")),
    "end_stop": ("mechanical", ("stiffness", "position")),
    "coulomb_friction": ("mechanical first_order", ("force",)),
    "asymmetric_friction": ("mechanical first_order", ("force_plus", "force_minus")),
    "asymmetric_damping": ("mechanical first_order", ("damping_plus", "damping_minus")),
    "stribeck_friction": ("mechanical first_order", ("coulomb_force", "static_force", "velocity")),
    "quadratic_damping": ("mechanical first_order", ("quadratic_damping",)),
    "cubic_damping": ("mechanical first_order", ("cubic_damping",)),
    "smooth_friction": ("mechanical first_order", ("force", "velocity")),
    "power_damping": ("mechanical first_order", ("damping", "power")),
    "soft_clearance": ("mechanical", ("stiffness", "gap", "softness")),
    "load_friction": ("mechanical", ("load_friction",)),
    "play": ("mechanical", ("stiffness", "gap")),
    "two_stops": ("mechanical", ("stiffness", "lower", "upper")),
    "lugre_friction": ("mechanical", ("force", "static_ratio", "velocity", "displacement")),
    "hysteresis": ("mechanical", ("force", "displacement")),
    "maxwell_element": ("mechanical first_order", ("stiffness", "time_constant")),
    "hidden_store": ("first_order", ("mass", "damping")),
    "hidden_mode": ("mechanical", ("mass", "damping", "stiffness")),
    "gravity": ("mechanical", ("torque",)),
    "cogging": ("mechanical", ("sine", "cosine", "period")),
    "magnetic_force": ("mechanical", ("strength",)),
    "radiation": ("first_order", ("radiation",)),
    "curved_loss": ("first_order", ("curvature",)),
    "exponential_loss": ("first_order", ("flow", "scale")),
    "state_dependent_gain": ("entry", ("slope", "curvature")),
    "product_of_states": ("entry", ("slope", "curvature")),
    "state_dependent_store": ("mechanical first_order", ("slope", "curvature")),
    "output_play": ("output", ("gap",)),
    "input_power": ("input", ("power", "level")),
    "input_asymmetry": ("input", ("difference",)),
    "input_play": ("input", ("gap",)),
    "input_rate_limit": ("input", ("rate",)),
    "constant_force": ("mechanical first_order", ("force",)),
    "sqrt_flow": ("first_order", ("flow",)),
    "threshold_flow": ("first_order", ("flow", "threshold")),
    "coefficient": ("any", ("value",)),
    "input_gain": ("input", ("gain",)),
    "input_offset": ("input", ("offset",)),
    "input_delay": ("input", ("delay",)),
    "input_lag": ("input", ("time_constant",)),
    "input_smoothing": ("input", ("time_constant",)),
    "input_deadzone": ("input", ("threshold",)),
    "input_saturation": ("input", ("limit",)),
    "input_range": ("input", ("low", "high")),
    "output_gain": ("output", ("gain",)),
    "output_offset": ("output", ("offset",)),
    "output_delay": ("output", ("delay",)),
    "output_average": ("output", ("window",)),
    "output_lag": ("output", ("time_constant",)),
    "output_saturation": ("output", ("limit",)),
    "output_range": ("output", ("low", "high")),
    "output_smoothing": ("output", ("kept",)),
    "output_curvature": ("output", ("curvature",)),
    "output_rectification": ("output", ("fraction",)),
    "clock": ("input", ("slow",)),
    "clocks_apart": ("input", ("apart", "slow")),
    "model_parameter": ("parameter", ("value",)),
    "custom": ("mechanical first_order any", ("scale",)),
    "tabulated": ("mechanical first_order", ("scale",)),
    "input_curve": ("input", ("scale",)),
    "output_curve": ("output", ("scale",)),
}


#: What has no other side: an absolute temperature.
ONE_SIDED = {"radiation"}
UNSIGNED = {"step": 0.1, "held": 1.0}


def square(d, v):
    return v * abs(v)


def power(d, v, *, a, b):
    return a * v + b * v**3


class TestKinds:
    def test_catalogue_is_that_of_the_design(self):
        assert {name: (kind.where, kind.coefficient_names) for name, kind in KINDS.items()} == {
            name: (frozenset(where.split()), names) for name, (where, names) in TABLE.items()
        }

    @pytest.mark.parametrize("name", TABLE)
    def test_words_and_bounds(self, name):
        kind = KINDS[name]
        assert kind.name == name
        assert kind.formula
        for text in (kind.explanation, kind.words[1] or kind.explanation):
            assert "{place}" in text
            assert text.endswith(".")
            assert len(text) < 130
        for coefficient in kind.coefficients:
            assert coefficient.explanation
            assert coefficient.lower < coefficient.upper
            if coefficient.default_start is not None:
                assert coefficient.lower <= coefficient.default_start <= coefficient.upper

    def test_bounds_of_physics(self):
        assert rco.Effect("input_delay", "u").bounds("delay") == (0.0, math.inf)
        assert rco.Effect("clearance", "link1").bounds("gap")[0] == 0.0
        assert rco.Effect("hidden_mode", "link1").bounds("mass")[0] == 0.0
        assert rco.Effect("output_rectification", "y").bounds("fraction") == (0.0, 1.0)
        assert rco.Effect("stiffness", "link1").bounds("stiffness") == (
            -math.inf,
            math.inf,
        )  # damage is negative

    @pytest.mark.parametrize(
        "name", [name for name, law in KINDS.items() if getattr(law, "arguments", ()) and not law.needs_law]
    )
    def test_what_acts_on_one_side_exists_for_the_other(self, name):
        """Turn every signal over: the force is turned over, for other values of the law or its other side."""
        law, rng = KINDS[name], np.random.default_rng(5)
        bounds = np.array([[c.lower, c.upper] for c in law.coefficients]).T
        values = rng.uniform(0.0, 0.9, len(law.coefficients)) + np.maximum(bounds[0], 0.1)
        constants = dict(law.constants) | {"width": 0.1}
        points = [{n: rng.uniform(-2.0, 2.0) for n in law.signals} for _ in range(12)]

        def forces(turn, values, side):
            """None where the values are outside the bounds of the law."""
            if not (bounds[0] <= values).all() or not (values <= bounds[1]).all():
                return None
            given = constants | {"side": side} | dict(zip(law.coefficient_names, values, strict=True))
            found = []
            for point in points:
                known = {n: turn * x for n, x in point.items()} | UNSIGNED | given
                if law.feels_inputs:
                    known["w"] = np.ones(2)
                found.append(law.law(**{n: known[n] for n in law.arguments}))
            return turn * np.array(found)

        wanted = forces(1.0, values, 1.0)
        others = (
            np.array(order) * signs
            for order in itertools.permutations(values)
            for signs in itertools.product((1.0, -1.0), repeat=len(values))
        )
        sides = (1.0, -1.0) if "side" in law.constants else (1.0,)
        there = any(
            (found := forces(-1.0, other, side)) is not None and np.allclose(found, wanted)
            for other in others
            for side in sides
        )
        assert there != (name in ONE_SIDED), law.formula

    def test_the_other_side_has_a_name_of_its_own(self):
        here = rco.Effect("bilinear_stiffness", "link1")
        there = here.replace(fixed={"side": -1})
        assert here.sides == [here, there]
        assert there.sides == [there]
        assert rco.Effect("stiffness", "link1").sides == [rco.Effect("stiffness", "link1")]
        model = rco.mass_spring_damper([1.0], [0.8], [100.0])
        assert {here.label, here.key}.isdisjoint({there.label, there.key})
        for name in (there.label, there.key):
            assert rco.describe_effects([name]) == rco.describe_effects([there])
            assert rco.describe_effects([name]) != ""
        assert there in [e for one in rco.effect_library(model) for e in one.sides]
        with pytest.raises(rco.ModelError, match="must be 1 or -1"):
            here.replace(fixed={"side": 2})

    def test_starts_that_must_be_found(self):
        nowhere = {
            (kind.name, coefficient.name)
            for kind in KINDS.values()
            for coefficient in kind.coefficients
            if coefficient.default_start is None
        }
        assert nowhere >= {
            ("clearance", "gap"),
            ("input_delay", "delay"),
            ("input_deadzone", "threshold"),
            ("hidden_mode", "stiffness"),
            ("stribeck_friction", "velocity"),
            ("output_rectification", "fraction"),
        }
        assert rco.Effect("stiffness", "a").start_of("stiffness") == 0.0

    def test_catalogue_cannot_be_changed_and_pickles(self):
        with pytest.raises(TypeError):
            KINDS["mine"] = KINDS["damping"]
        for kind in KINDS.values():
            assert pickle.loads(pickle.dumps(kind)) is kind

    def test_linear_kinds(self):
        linear = {name for name, kind in KINDS.items() if kind.linear}
        assert linear == {
            "stiffness", "damping", "mass", "maxwell_element", "hidden_store", "hidden_mode", "coefficient",
            "input_gain", "input_delay", "input_lag", "output_gain", "output_delay", "output_lag", "clock",
            "output_average",
        }  # fmt: skip


class TestEffect:
    def test_label_and_explanation(self):
        effect = rco.Effect("coulomb_friction", "link2")
        assert effect.label == str(effect) == "coulomb_friction at link2"
        assert "link2" in effect.explanation
        assert str([effect]) == "[Effect('coulomb_friction', 'link2')]"
        assert rco.Effect("damping", "a", name="new damper").label == "new damper"

    def test_words_fit_the_kind_of_place(self):
        model = rco.two_tanks()
        effect = model.check(rco.Effect("damping", "tank1"))
        assert effect.label == "outflow in proportion at tank1"
        assert effect == rco.Effect("damping", "tank1")
        assert pickle.loads(pickle.dumps(effect)).label == effect.label
        assert effect.replace(start={"damping": 1.0}).explanation == effect.explanation

    @pytest.mark.parametrize(
        "model",
        [
            rco.series_rlc(1.0, 0.1, 0.01),
            rco.dc_motor(R=1.0, L=0.01, Kt=0.1, J=0.01),
            rco.thermal_network([1e4, 2e4], {(1, 0): 0.01, (1, 2): 0.1}),
            rco.two_tanks(),
        ],
        ids=lambda model: model.name,
    )
    def test_no_joint_is_spoken_of_where_there_is_none(self, model):
        mechanical = (
            "damping friction stiffness spring mass force displacement speed joint motion shock".split()
        )
        for effect in rco.effect_library(model):
            if effect.place not in ("shaft", *model.linear.input_labels, *model.linear.output_labels):
                said = f"{effect.label} {effect.explanation}".replace("_", " ").lower().split()
                assert not [word for word in mechanical if word in said], effect.label

    def test_equality_and_hash(self):
        plain = rco.Effect("clearance", "link1")
        assert plain == rco.Effect("clearance", "link1", start={"gap": 0.1}, prior={"gap": 0.1})
        assert len({plain, rco.Effect("clearance", "link1"), rco.Effect("clearance", "link2")}) == 2
        assert plain != rco.Effect("clearance", "link1", fixed={"gap": 0.1})
        assert plain != "clearance"

    def test_fixed_coefficients_and_constants(self):
        effect = rco.Effect("stribeck_friction", "a", fixed={"velocity": 0.1, "width": 1e-3})
        assert effect.coefficients == ("coulomb_force", "static_force", "velocity")
        assert effect.free == ("coulomb_force", "static_force")
        assert effect.constants == {"width": 1e-3}
        assert effect.start_of("velocity") == 0.1
        assert rco.Effect("coulomb_friction", "a").constants == {"width": None}

    def test_start_and_prior(self):
        effect = rco.Effect("damping", "a", start={"damping": 2}, prior={"damping": 0.5})
        assert effect.start == {"damping": 2.0}
        assert effect.start_of("damping") == 2.0
        assert effect.prior == {"damping": 0.5}
        effect.start["damping"] = 9.0  # a copy
        assert effect.start == {"damping": 2.0}

    def test_custom_laws(self):
        assert rco.Effect("custom", "a", law=square).coefficients == ("scale",)
        effect = rco.Effect("custom", "a", law=power, start={"a": 1.0, "b": 0.0})
        assert effect.coefficients == ("a", "b")
        assert effect.bounds("a") == (-math.inf, math.inf)
        held = rco.Effect("custom", "a", law=power, start={"a": 1.0, "b": 0.0}, fixed={"b": 2.0})
        assert held.free == ("a",)
        assert held.start_of("b") == 2.0
        again = pickle.loads(pickle.dumps(effect))
        assert again == effect
        assert again.law is power
        assert effect != rco.Effect("custom", "a", law=square, start={"a": 1.0, "b": 0.0})

    def test_immutable_and_copyable(self):
        effect = rco.Effect("damping", "a", start={"damping": 2.0})
        with pytest.raises(AttributeError, match="replace"):
            effect.place = "b"
        with pytest.raises(AttributeError):
            del effect.place
        for other in (copy.copy(effect), copy.deepcopy(effect), pickle.loads(pickle.dumps(effect))):
            assert other == effect
            assert other.start == effect.start
        moved = effect.replace(place="b")
        assert (moved.place, moved.start, effect.place) == ("b", {"damping": 2.0}, "a")

    def test_repr_makes_it_again(self):
        effect = rco.Effect("clearance", "a", start={"gap": 0.5}, fixed={"stiffness": 3.0}, name="stop")
        again = eval(repr(effect), {"Effect": rco.Effect})
        assert again == effect
        assert again.start == effect.start

    @pytest.mark.parametrize(
        "arguments, keywords, message",
        [
            (
                ("friction", "a"),
                {},
                "effect 'friction'; near it: coulomb_friction, .*; the kinds are stiffness",
            ),
            ((["damping"], "a"), {}, "unknown kind"),
            (("damping", 3), {}, r"ports\(model\)"),
            (("damping", " "), {}, "must be the name"),
            (("damping", "a"), {"start": {"force": 1.0}}, "no such coefficient, only damping"),
            (("damping", "a"), {"start": {"damping": "x"}}, "must be a number"),
            (("damping", "a"), {"start": {"damping": math.nan}}, "must be finite"),
            (("damping", "a"), {"prior": {"damping": 0.0}}, "must be positive"),
            (("input_delay", "a"), {"start": {"delay": -1.0}}, "outside"),
            (("input_delay", "a"), {"fixed": {"delay": -1.0}}, "outside"),
            (("clearance", "a"), {"start": {"gap": 1.0}, "fixed": {"gap": 1.0}}, "both fixed"),
            (("coulomb_friction", "a"), {"fixed": {"width": 0.0}}, "must be positive"),
            (("coulomb_friction", "a"), {"start": {"width": 1.0}}, "no such coefficient"),
            (("custom", "a"), {}, "needs law="),
            (("damping", "a"), {"law": square}, "for kind 'custom' only"),
            (("damping", "a"), {"name": 3}, "name of damping"),
        ],
    )
    def test_what_is_wrong_is_said(self, arguments, keywords, message):
        with pytest.raises((ct.ControlArgument, rco.ModelError), match=message):
            rco.Effect(*arguments, **keywords)

    def test_unknown_keyword(self):
        with pytest.raises(TypeError):
            rco.Effect("damping", "a", value=3.0)


class TestUnits:
    @pytest.mark.parametrize(
        "kind, coefficient, unit",
        [
            ("stiffness", "stiffness", "N/m"),
            ("damping", "damping", "N s/m"),
            ("mass", "mass", "kg"),
            ("cubic_stiffness", "cubic_stiffness", "N/m^3"),
            ("quadratic_damping", "quadratic_damping", "N s^2/m^2"),
            ("coulomb_friction", "force", "N"),
            ("clearance", "gap", "m"),
            ("stribeck_friction", "velocity", "m/s"),
            ("hidden_mode", "mass", "kg"),
            ("custom", "scale", "N"),
        ],
    )
    def test_mechanical(self, kind, coefficient, unit):
        law = {"law": square} if kind == "custom" else {}
        assert rco.mass_spring_damper(1, 1, 1).unit(rco.Effect(kind, "link1", **law), coefficient) == unit

    def test_electrical_and_hydraulic(self):
        circuit = rco.series_rlc(1.0, 1.0, 1.0)
        assert circuit.unit(rco.Effect("damping", "resistor"), "damping") == "Ohm"
        assert circuit.unit(rco.Effect("mass", "inductor"), "mass") == "H"
        assert circuit.unit(rco.Effect("stiffness", "capacitor"), "stiffness") == "1/F"
        tanks = rco.two_tanks(level_unit="cm", flow_unit="cm^3/s")
        assert tanks.unit(rco.Effect("sqrt_flow", "tank1"), "flow") == "cm^2.5/s"
        assert tanks.unit(rco.Effect("threshold_flow", "tank1->tank2"), "threshold") == "cm"

    def test_channels_and_entries(self):
        model = rco.mass_spring_damper(1, 1, 1)
        assert model.unit(rco.Effect("input_deadzone", "force"), "threshold") == "N"
        assert model.unit(rco.Effect("input_delay", "force"), "delay") == "s"
        assert model.unit(rco.Effect("output_gain", "q1"), "gain") == "1"
        assert model.unit(rco.Effect("coefficient", "A[v1,q1]"), "value") == "1/s^2"

    def test_unknown_units_stay_unknown(self):
        model = rco.mass_spring_damper(1, 1, 1, position_unit="", force_unit="N")
        assert model.unit(rco.Effect("stiffness", "link1"), "stiffness") == ""
        with pytest.raises(ct.ControlArgument, match="no coefficient"):
            model.unit(rco.Effect("stiffness", "link1"), "damping")

    @pytest.mark.parametrize(
        "rule, unit",
        [
            ("a/b", "N s/m"),
            ("a b", "N m/s"),
            ("b/b", "1"),
            ("1", "1"),
            ("1/b", "s/m"),
            ("c/b", "kg s/(m^2 K)"),
            ("b^0.5", "m^0.5/s^0.5"),
            ("missing/a", "missing/N"),
        ],
    )
    def test_algebra(self, rule, unit):
        assert combine_units(rule, {"a": "N", "b": "m/s", "c": "kg/(m K)"}) == unit


class TestCheck:
    def test_places_of_a_model(self):
        model = rco.mass_spring_damper([1, 1], [1, 1], [1, 1])
        for effect in (
            rco.Effect("stiffness", "link2"),
            rco.Effect("input_lag", "force"),
            rco.Effect("output_gain", "q1"),
        ):
            assert model.check(effect) == effect
        assert model.check(rco.Effect("coefficient", "A[2,0]"))
        assert model.check(rco.Effect("custom", "mass1", law=square))

    @pytest.mark.parametrize(
        "effect, message",
        [
            (rco.Effect("stiffness", "link9"), "its ports are: link1, link2"),
            (rco.Effect("stiffness", "force"), "no port 'force'"),
            (rco.Effect("input_gain", "q1"), "none of them: force"),
            (rco.Effect("output_gain", "force"), "none of them: q1, q2"),
            (rco.Effect("sqrt_flow", "link1"), "cannot sit at link1, a mechanical port"),
            (rco.Effect("coefficient", "A[9,9]"), "no entry of the model"),
        ],
    )
    def test_misplaced(self, effect, message):
        with pytest.raises(rco.ModelError, match=message):
            rco.mass_spring_damper([1, 1], [1, 1], [1, 1]).check(effect)

    def test_no_displacement_no_stiffness(self):

        with pytest.raises(rco.ModelError, match="no position at shaft"):
            rco.dc_motor(gain=1.0, time_constant=1.0).check(rco.Effect("stiffness", "shaft"))
        with pytest.raises(rco.ModelError, match="cannot sit at tank1, a first-order port"):
            rco.two_tanks().check(rco.Effect("stiffness", "tank1"))
        with pytest.raises(ct.ControlArgument, match="must be an Effect"):
            rco.two_tanks().check("damping at tank1")


def test_table_of_effects_fits_a_terminal():
    curve = {"law": rco.Table([0.0, 1.0], force=[0.0, 2.0])}
    given = {"custom": {"law": square}, "tabulated": curve, "input_curve": curve, "output_curve": curve}
    effects = [rco.Effect(name, "somewhere", **given.get(name, {})) for name in KINDS]
    text = rco.describe_effects(effects)
    assert max(map(len, text.splitlines())) <= 80
    assert all(name in text and kind.formula[:40] in text for name, kind in KINDS.items())


def test_describe_effects_takes_a_model():
    model = rco.mass_spring_damper(1.0, 0.4, 100.0)
    assert rco.describe_effects(model) == rco.describe_effects(rco.effect_library(model))
    assert rco.describe_effects(model.system) == rco.describe_effects(rco.effect_library(model.system))


# ------------------------------------------------------------------ names
def test_every_printed_name_is_accepted_and_means_one_kind():
    from rcorefine.effects.domains import DOMAINS, kind_named, worded

    for kind, law in KINDS.items():
        assert kind_named(kind) == kind_named(kind.replace("_", " ").title()) == kind
        for domain in DOMAINS:
            printed = worded(law.words[0], domain)
            if printed:
                assert kind_named(printed.upper()) == kind, (printed, domain)


@pytest.mark.parametrize("wrong", ["stifness", "friction", "voltage drop of constants size"])
def test_an_unknown_name_is_answered_with_the_nearest(wrong):
    with pytest.raises(ct.ControlArgument, match="near it: [a-z_]+") as told:
        rco.Effect(wrong, "link1")
    near = str(told.value).split("near it: ")[1].split(";")[0].split(", ")
    assert 1 <= len(near) <= 3
    assert set(near) <= set(KINDS)


def test_effects_by_their_names_are_candidates():
    model = rco.series_rlc(1.0, 0.1, 0.01)
    label = rco.effect_library(model)[0].label
    from rcorefine.effects.effect import as_effects

    assert label == "series resistance at inductor"
    assert as_effects(["damping@inductor", label], "candidates") == 2 * [rco.Effect("damping", "inductor")]
    assert rco.Effect("damping", "inductor").key == "damping@inductor"
    for text in ("damping", "@inductor", "damping at "):
        with pytest.raises(ct.ControlArgument, match="kind@place"):
            as_effects([text], "candidates")


@pytest.mark.parametrize(
    ("state", "domain"),
    [("speed", "mechanical"), ("omega1", "rotational"), ("level2", "hydraulic"), ("temperature", "thermal")],
)
def test_states_without_a_unit_have_the_words_of_their_name(state, domain):
    model = ct.ss([[-2.0]], [[3.0]], [[1.0]], 0, inputs="u", outputs="y", states=state)
    (port,) = rco.ports(model)
    assert port.domain == domain
