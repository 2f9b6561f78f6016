"""What effect_library offers, and what it leaves out."""

import control as ct
import numpy as np
import pytest
from inner import KINDS

import rcorefine as rco


def listed(model, **options):
    return {(effect.kind, effect.place) for effect in rco.effect_library(model, **options)}


def pendulum(**labels):
    return ct.ss([[0, 1], [-4, -0.1]], [[0], [1]], [[1, 0]], 0, **labels)


class TestChain:
    model = rco.mass_spring_damper([1, 2, 3], [1, 1, 1, 1], [10, 20, 30, 40], sensors=("velocity", 1))

    def test_every_link_has_the_eight_laws_of_the_trials(self):
        found = listed(self.model)
        for link in ("link1", "link2", "link3", "link4"):
            for kind in ("stiffness", "damping", "cubic_stiffness", "bilinear_stiffness", "clearance",
                         "coulomb_friction", "quadratic_damping", "cubic_damping"):  # fmt: skip
                assert (kind, link) in found

    def test_size_order_and_uniqueness(self):
        library = rco.effect_library(self.model)
        assert len(library) == len(set(library))
        assert 60 <= len(library) <= 120
        places = list(dict.fromkeys(effect.place for effect in library))
        assert places == ["link1", "link2", "link3", "link4", "mass1", "mass2", "mass3", "force", "v1"]
        assert library[0].kind == "stiffness"

    def test_no_spring_to_the_ground_where_there_is_none(self):
        found = listed(self.model)
        assert ("stiffness", "mass2") not in found
        assert ("coulomb_friction", "mass2") in found  # drag on the middle mass
        assert ("hidden_mode", "mass2") in found

    def test_alike_effects_once(self):
        # link1 and mass1 are the same direction: springs at the link, bodies at the mass
        found = listed(self.model)
        assert ("damping", "link1") in found
        assert ("damping", "mass1") not in found
        assert ("mass", "mass1") in found
        assert ("mass", "link1") not in found

    def test_base_excitation_keeps_bodies_at_the_mass(self):
        found = listed(rco.mass_spring_damper(1, 1, 1, excitation="base", sensors="acceleration"))
        assert ("mass", "mass1") in found
        assert ("mass", "link1") not in found  # an inerter, unless asked for
        assert ("mass", "link1") in listed(
            rco.mass_spring_damper(1, 1, 1, excitation="base", sensors="acceleration"), kinds="mass"
        )

    def test_kinds_and_places(self):
        assert listed(self.model, kinds="stiffness", places=["link2", "mass2"]) == {
            ("stiffness", "link2"),
            ("stiffness", "mass2"),  # asked for by kind
        }
        assert {place for _, place in listed(self.model, places="force")} == {"force"}
        assert listed(self.model, kinds=["coefficient"], places=["A[3,0]"]) == {("coefficient", "A[3,0]")}
        assert listed(self.model, places=["A[v1,q1]"]) == {("coefficient", "A[v1,q1]")}

    @pytest.mark.parametrize(
        "options, error, message",
        [
            ({"kinds": "friction"}, ct.ControlArgument, "unknown kind"),
            ({"kinds": "custom"}, ct.ControlArgument, "needs its law"),
            ({"places": "link9"}, rco.ModelError, "no place 'link9'; the places are link1"),
            ({"places": "A[9,9]"}, rco.ModelError, "no entry of the model"),
            ({"kinds": []}, ct.ControlArgument, "kinds must be"),
            ({"kinds": "sqrt_flow"}, rco.ModelError, "no effect of kind sqrt_flow"),
            ({"kinds": "stiffness", "places": "force"}, rco.ModelError, "can sit at force"),
        ],
    )
    def test_what_is_wrong_is_said(self, options, error, message):
        with pytest.raises(error, match=message):
            rco.effect_library(self.model, **options)


class TestOtherModels:
    def test_circuit_effects_sit_at_their_component(self):
        found = listed(rco.series_rlc(250.0, 0.055, 23.5e-6))
        assert {("mass", "inductor"), ("damping", "resistor"), ("stiffness", "capacitor")} <= found
        assert not {("mass", "resistor"), ("damping", "capacitor"), ("stiffness", "inductor")} & found

    def test_tanks(self):
        found = listed(rco.two_tanks())
        for kind in ("sqrt_flow", "threshold_flow", "damping"):
            assert {(kind, place) for place in ("tank1", "tank2", "tank1->tank2")} <= found
        assert ("output_saturation", "h2") in found
        assert not any(kind in ("stiffness", "hidden_mode", "hysteresis") for kind, _ in found)

    def test_heat_has_no_orifice(self):
        found = listed(rco.thermal_network([1.0, 2.0], {(1, 2): 1.0, (2, 0): 1.0}))
        assert ("damping", "T1-T2") in found
        assert ("sqrt_flow", "T1-T2") not in found

    def test_motor_without_angle_has_no_spring(self):
        found = listed(rco.dc_motor(gain=35.0, time_constant=0.28))
        assert {("coulomb_friction", "shaft"), ("asymmetric_friction", "shaft")} <= found
        assert {("input_deadzone", "voltage"), ("input_delay", "voltage")} <= found
        assert not any(kind in ("stiffness", "clearance") for kind, _ in found)
        with_angle = listed(rco.dc_motor(gain=35.0, time_constant=0.28, sensors="angle"))
        assert ("stiffness", "shaft") in with_angle

    def test_car(self):
        found = listed(rco.quarter_car(250.0, 35.0, 16e3, 1e3, 160e3))
        assert {("asymmetric_damping", "suspension"), ("bilinear_stiffness", "tire")} <= found
        assert ("mass", "wheel") in found
        assert ("mass", "tire") not in found

    def test_general_structure(self):
        model = rco.mechanical([1, 1], K=[[2, -1], [-1, 1.0]], damping_ratio=0.01)
        found = listed(model)
        assert ("stiffness", "mass1-mass2") in found
        assert ("stiffness", "mass1") in found  # it stands on a spring
        assert ("stiffness", "mass2") not in found


class TestPlainStateSpace:
    def test_mass_on_a_spring(self):
        found = listed(pendulum(states=["q", "v"], inputs="u", outputs="y"))
        assert {("stiffness", "q"), ("coulomb_friction", "q"), ("mass", "q")} <= found
        assert {place for _, place in found} == {"q", "u", "y"}

    def test_free_mass_may_lack_its_only_spring(self):
        found = listed(ct.ss([[0, 1], [0, -2]], [[0], [0.01]], [[1, 0]], 0, states=["q", "v"]))
        assert ("stiffness", "q") in found
        assert ("asymmetric_friction", "q") in found

    def test_first_order(self):
        found = listed(ct.ss(-3.5, 125, 1, 0, states=["rpm"], inputs="volts", outputs="y"))
        assert {("coulomb_friction", "rpm"), ("input_deadzone", "volts"), ("input_delay", "volts")} <= found
        assert ("mass", "rpm") not in found  # only rescales the row

    def test_arbitrary_coordinates_offer_entries_and_channels(self, rng):
        T = rng.normal(size=(2, 2))
        sys = pendulum()
        other = ct.ss(T @ sys.A @ np.linalg.inv(T), T @ sys.B, sys.C @ np.linalg.inv(T), 0)
        found = listed(other)
        assert {("coefficient", "A[0,1]"), ("coefficient", "A[1,0]")} <= found
        assert not any(kind in ("stiffness", "clearance", "hysteresis") for kind, _ in found)

    def test_large_model_in_arbitrary_coordinates_does_not_flood(self, rng):
        sys = ct.ss(rng.normal(size=(12, 12)) - 5 * np.eye(12), rng.normal(size=(12, 1)), np.eye(12)[:1], 0)
        assert not any(kind == "coefficient" for kind, _ in listed(sys))
        assert len(listed(sys, kinds="coefficient")) == 144 + 12  # of A and B

    def test_discrete_time(self):
        sampled = ct.c2d(pendulum(states=["q", "v"]), 0.01)
        assert ("stiffness", "q") in listed(sampled)

    def test_wrong_type(self):
        with pytest.raises(ct.ControlArgument, match="StateSpace"):
            rco.effect_library(np.eye(2))


def test_explanations_read_well_everywhere():
    models = [
        TestChain.model,
        rco.two_tanks(),
        rco.series_rlc(1.0, 1.0, 1.0),
        rco.thermal_network([1.0], {(1, 0): 1.0}),
        rco.quarter_car(250.0, 35.0, 16e3, 1e3, 160e3),
    ]
    for model in models:
        for effect in rco.effect_library(model):
            assert effect.place in effect.explanation
            assert effect.explanation.endswith(".")
            assert "{" not in effect.explanation


def test_every_kind_is_offered_somewhere():
    swing = ct.ss([[0, 1], [-9, -1]], [[0], [1]], [[1, 0]], 0, states=["theta", "omega"])
    models = [TestChain.model, rco.two_tanks(), ct.ss([[-1, 2], [-3, -4]], [[1], [0]], [[1, 0]], 0), swing]
    offered = {kind for model in models for kind, _ in listed(model)}
    assert offered == {name for name, law in KINDS.items() if not (law.on_request or law.needs_law)}
