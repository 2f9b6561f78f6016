"""Ports, parameters and accelerometers found in a plain StateSpace."""

import pickle

import control as ct
import numpy as np
import pytest
from inner import as_physical

import rcorefine as rco

CHAIN_M = np.diag([0.8, 0.5])
CHAIN_C = np.array([[300.0, -200.0], [-200.0, 320.0]])  # c = 100, 200, 120
CHAIN_K = np.array([[26000.0, -25000.0], [-25000.0, 50000.0]])  # k = 1000, 25000, 25000


def state_matrix(M, C, K):
    n = len(M)
    A = np.zeros((2 * n, 2 * n))
    A[:n, n:] = np.eye(n)
    A[n:, :n], A[n:, n:] = -np.linalg.solve(M, K), -np.linalg.solve(M, C)
    return A


def chain(**labels):
    A = state_matrix(CHAIN_M, CHAIN_C, CHAIN_K)
    B = np.array([[0.0], [0.0], [1 / 0.8], [0.0]])
    labels = {"states": ["x1", "x2", "v1", "v2"], "inputs": "f", "outputs": "y"} | labels
    return ct.ss(A, B, [[0, 0, 1.0, 0]], 0, **labels)


def reordered(sys, order):
    order = list(order)
    states = [sys.state_labels[i] for i in order]
    signals = {"states": states, "inputs": sys.input_labels, "outputs": sys.output_labels}
    return ct.ss(sys.A[np.ix_(order, order)], sys.B[order], sys.C[:, order], sys.D, sys.dt, **signals)


def values(model):
    return {item.name: item.value for item in model.parameters}


def kinds(sys):
    return [port.kind for port in rco.ports(sys)]


class TestMechanical:
    def test_chain_has_masses_and_link(self):
        found = {port.name: port for port in rco.ports(chain())}
        assert list(found) == ["x1", "x2", "x1-x2"]
        np.testing.assert_allclose(found["x1"].act, [0, 0, -1 / 0.8, 0])
        np.testing.assert_allclose(found["x2"].act, [0, 0, 0, -1 / 0.5])
        np.testing.assert_allclose(found["x1-x2"].act, [0, 0, -1 / 0.8, 1 / 0.5])
        np.testing.assert_allclose(found["x1-x2"].position, [1, -1, 0, 0])
        np.testing.assert_allclose(found["x1-x2"].velocity, [0, 0, 1, -1])
        assert "mass 0.8 from the input f" in found["x1"].description

    def test_parameters_are_those_of_the_paper(self):
        expected = {
            "k[x1-x2]": 25e3,
            "c[x1-x2]": 200,
            "k[x1]": 1e3,
            "c[x1]": 100,
            "k[x2]": 25e3,
            "c[x2]": 120,
        }
        found = values(rco.PhysicalModel.from_statespace(chain()))
        assert found == pytest.approx({**expected, "gain[f]": 1.0}, rel=1e-9)

    @pytest.mark.parametrize("order", [(2, 3, 0, 1), (3, 1, 0, 2), (0, 2, 1, 3), (1, 0, 2, 3)])
    def test_any_order_of_states(self, order):
        model = rco.PhysicalModel.from_statespace(reordered(chain(), order))
        plain = rco.PhysicalModel.from_statespace(chain())
        expected = {port.name: port for port in plain.ports}
        for port in model.ports:
            name = port.name if port.name in expected else "x1-x2"
            sign = 1.0 if port.name in expected else -1.0  # x2-x1 where x2 comes first
            np.testing.assert_allclose(port.act, sign * expected[name].act[list(order)])
            np.testing.assert_allclose(port.position, sign * expected[name].position[list(order)])
        assert sorted(values(model).values()) == pytest.approx(sorted(values(plain).values()))

    def test_ten_masses_with_unknown_input_scale(self, rng):
        n = 10
        m, k, c = rng.uniform(1, 5, n), rng.uniform(100, 900, n + 1), rng.uniform(1, 3, n + 1)
        G = np.vstack([np.eye(n) - np.eye(n, k=-1), np.eye(n)[-1]])
        A = state_matrix(np.diag(m), G.T @ np.diag(c) @ G, G.T @ np.diag(k) @ G)
        B = np.zeros((2 * n, 2))
        B[n, 0], B[n + 3, 0], B[n + 5, 1] = 1, 1, 1 / m[5]  # the second tells the scale
        order = rng.permutation(2 * n)
        states = [f"{x}{i}" for x in "xv" for i in range(n)]
        model = rco.PhysicalModel.from_statespace(
            reordered(ct.ss(A, B, np.eye(2 * n)[:1], 0, states=states), order)
        )
        found = values(model)
        assert found["k[x0]"] == pytest.approx(k[0])
        assert found[f"k[x{n - 1}]"] == pytest.approx(k[n])
        for i in range(1, n):
            name = f"x{i - 1}-x{i}"
            name = name if f"k[{name}]" in found else f"x{i}-x{i - 1}"
            assert found[f"k[{name}]"] == pytest.approx(k[i])
            assert found[f"c[{name}]"] == pytest.approx(c[i])
        assert len(model.ports) == n + n - 1

    def test_free_mass_without_any_spring(self):
        model = rco.PhysicalModel.from_statespace(
            ct.ss([[0, 1], [0, -2.14]], [[0], [1 / 95.1]], [[1, 0]], 0, states=["q", "v"], inputs="force")
        )
        assert model.port("q").kind == "mechanical"
        assert values(model) == pytest.approx({"c[q]": 2.14 * 95.1, "gain[force]": 1.0})

    def test_two_masses_joined_by_a_damper_only(self):
        C = np.array([[2.0, -2.0], [-2.0, 2.0]])
        A = state_matrix(np.diag([1.0, 4.0]), C, np.zeros((2, 2)))
        model = rco.PhysicalModel.from_statespace(ct.ss(A, [[0], [0], [1], [0]], [[1, 0, 0, 0]], 0))
        assert [port.name for port in model.ports] == ["x[0]", "x[1]", "x[0]-x[1]"]
        assert values(model)["c[x[0]-x[1]]"] == pytest.approx(2.0)
        np.testing.assert_allclose(model.port("x[0]-x[1]").act, [0, 0, -1, 0.25])

    def test_one_way_coupling_is_not_a_link(self):
        K = np.array([[3.0, 0.0], [-1.0, 2.0]])  # mass 2 feels mass 1, not the reverse
        A = state_matrix(np.eye(2), 0.1 * np.eye(2), K)
        model = rco.PhysicalModel.from_statespace(ct.ss(A, [[0], [0], [1], [0]], [[1, 0, 0, 0]], 0))
        assert [port.name for port in model.ports] == ["x[0]", "x[1]"]
        assert [item.place for item in model.parameters if item.kind == "coefficient"] == ["A[3,0]"]

    def test_loop_that_no_masses_make_symmetric_is_no_loop_of_links(self):
        K = np.array([[3.0, -1, -1], [-1, 3, -1], [-1, -5, 3]])  # ratios 1, 1, but 5 between 2 and 3
        A = state_matrix(np.eye(3), np.zeros((3, 3)), K)
        assert [port.name for port in rco.ports(ct.ss(A, np.eye(6)[:, 3:4], np.eye(6)[:1], 0))] == [
            "x[0]", "x[1]", "x[2]"
        ]  # fmt: skip

    def test_one_unsymmetric_link_among_many_is_the_one_dropped(self):
        K = 10 * np.eye(4) - np.ones((4, 4))
        K[1, 3] = -4.0
        m = np.array([1.0, 2.0, 3.0, 4.0])
        A = state_matrix(np.diag(m), np.zeros((4, 4)), K)
        relative = {
            port.name: port
            for port in rco.ports(ct.ss(A, np.eye(8)[:, 4:5], np.eye(8)[:1], 0))
            if port.is_relative
        }
        assert set(relative) == {"x[0]-x[1]", "x[0]-x[2]", "x[0]-x[3]", "x[1]-x[2]", "x[2]-x[3]"}
        np.testing.assert_allclose(relative["x[2]-x[3]"].act[4:], [0, 0, -1 / 3, 1 / 4])

    def test_dense_unsymmetric_model_is_quick_and_sane(self, rng):
        n = 30
        K = 10 * n * np.eye(n) - rng.uniform(0.1, 1, (n, n))
        sys = ct.ss(
            state_matrix(np.eye(n), np.zeros((n, n)), K), np.eye(2 * n)[:, n:][:, :1], np.eye(2 * n)[:1], 0
        )
        for port in rco.ports(sys):
            assert port.kind == "mechanical"
            assert np.count_nonzero(port.act) == 1 or port.act.min() < 0 < port.act.max()

    def test_gyroscopic_damping_keeps_the_ports(self):
        A = state_matrix(np.eye(2), np.array([[0.1, 5.0], [-5.0, 0.1]]), np.diag([4.0, 9.0]))
        model = rco.PhysicalModel.from_statespace(ct.ss(A, np.eye(4)[:, 2:], np.eye(4)[:2], 0))
        assert [port.name for port in model.ports] == ["x[0]", "x[1]"]
        assert values(model)["A[2,3]"] == -5.0

    def test_displacement_in_millimeters(self):
        T = np.diag([1000.0, 1000.0, 1.0, 1.0])
        sys = chain()
        scaled = ct.ss(T @ sys.A @ np.linalg.inv(T), T @ sys.B, sys.C @ np.linalg.inv(T), 0)
        model = rco.PhysicalModel.from_statespace(scaled)
        link = model.port("x[0]-x[1]")
        np.testing.assert_allclose(link.velocity, [0, 0, 1000, -1000])
        np.testing.assert_allclose(link.act, [0, 0, -1 / 0.8, 2.0])
        assert values(model)["k[x[0]-x[1]]"] == pytest.approx(25.0)  # N/mm

    def test_masses_in_different_length_units(self):
        T = np.diag([1000.0, 1.0, 1.0, 1.0])
        sys = chain()
        model = rco.PhysicalModel.from_statespace(ct.ss(T @ sys.A @ np.linalg.inv(T), T @ sys.B, sys.C, 0))
        link = model.port("x[0]-x[1]")
        np.testing.assert_allclose(link.position, [1, -1000, 0, 0])
        np.testing.assert_allclose(link.act, [0, 0, -1 / 0.8, 2.0])

    def test_inductor_and_capacitor_voltage(self):
        R, L, C = 2.0, 0.1, 1e-3
        sys = ct.ss([[0, 1 / C], [-1 / L, -R / L]], [[0], [1 / L]], [[1, 0]], 0, states=["vC", "i"])
        port = rco.PhysicalModel.from_statespace(sys).port("vC")
        assert port.kind == "mechanical"
        np.testing.assert_allclose(port.velocity, [0, 1 / C])  # rate of the voltage
        np.testing.assert_allclose(port.act, [0, -1 / L])

    def test_base_acceleration_of_the_paper(self):
        M, K, C = 200.0, 63500.0, 15000.0
        row = [-K / M, -C / M]
        model = rco.PhysicalModel.from_statespace(ct.ss([[0, 1], row], [[0], [-1]], [row], 0))
        np.testing.assert_array_equal(model.ports[0].acceleration_input, [1.0])
        np.testing.assert_array_equal(model.output_rate, [[0, 1]])
        np.testing.assert_array_equal(model.output_state, [[0, 0]])
        np.testing.assert_array_equal(model.output_input, [[1]])  # y = q'' + w, the absolute acceleration
        assert values(model) == pytest.approx({"k[x[0]]": K / M, "c[x[0]]": C / M})

    def test_quarter_car_with_deflections_as_states(self):
        ms, mu, ks, cs, kt, ctire = 250.0, 35.0, 16e3, 1e3, 160e3, 50.0
        A = [
            [0, 1, 0, -1],
            [-ks / ms, -cs / ms, 0, cs / ms],
            [0, 0, 0, 1],
            [ks / mu, cs / mu, -kt / mu, -(cs + ctire) / mu],
        ]
        B = [[0], [0], [-1], [ctire / mu]]
        sys = ct.ss(A, B, [[1, 0, 0, 0]], 0, states=["susp", "vs", "tire", "vu"])
        model = rco.PhysicalModel.from_statespace(sys)
        found = {port.name: port for port in model.ports}
        assert list(found) == ["susp", "vs", "tire", "vu"]
        assert all(port.kind == "mechanical" for port in model.ports)
        np.testing.assert_allclose(found["susp"].velocity, [0, 1, 0, -1])
        np.testing.assert_allclose(found["susp"].act, [0, -1, 0, ms / mu])  # per unit body mass
        np.testing.assert_allclose(found["tire"].velocity_input, [-1])
        per_mass = values(model)
        assert per_mass["k[susp]"] == pytest.approx(ks / ms)
        assert per_mass["c[susp]"] == pytest.approx(cs / ms)
        assert per_mass["k[tire]"] == pytest.approx(kt / ms)
        assert per_mass["c[tire]"] == pytest.approx(ctire / ms)
        assert not found["vs"].has_position


class TestNotMechanical:
    @pytest.mark.parametrize("n", [3, 4, 5, 6])
    @pytest.mark.parametrize("form", ["reachable", "observable"])
    def test_canonical_forms(self, n, form, rng):
        for _ in range(5):
            poles = -rng.uniform(0.1, 5, n)
            sys = ct.ss(ct.tf([1.0, 2.0], np.real(np.poly(poles))))
            canonical, _ = ct.canonical_form(sys, form)
            canonical = ct.ss(
                np.where(np.abs(canonical.A) < 1e-12, 0, canonical.A), canonical.B, canonical.C, 0
            )
            for order in (range(n), reversed(range(n)), rng.permutation(n)):
                assert kinds(reordered(canonical, order)) == ["first_order"] * n

    @pytest.mark.parametrize(
        ("A", "B"),
        [
            # s^4 + 3 s^2 + 2: rows of a single one, as two displacements would have
            ([[0, 1, 0, 0], [-3, 0, 1, 0], [0, 0, 0, 1], [-2, 0, 0, 0.0]], [[0], [0], [0], [1]]),
            ([[0, 1, 0, 0], [-3, 0, 1, 0], [0, 0, 0, 1], [-2, 0, 0, 0.0]], [[0], [1], [0], [1.0]]),
            *(([[-2, 1], [-a0, 0]], [[0], [gain]]) for a0 in (1.0, 3.0) for gain in (0.5, 1.0, 3.0)),
            (np.eye(4, k=1), np.eye(4)[:, 3:]),  # a chain of integrators
            ([[0, 1, 0], [-4, -1, -2], [1, 0, 0.0]], [[0], [1], [0]]),  # z' = q, and z acts back
        ],
    )
    def test_forms_that_may_be_canonical_have_no_displacement(self, A, B):
        n = len(A)
        assert kinds(ct.ss(A, B, np.eye(n)[:1], 0)) == ["first_order"] * n

    @pytest.mark.parametrize(
        ("A", "states", "expected"),
        [
            # x2' = x1, x1' = -2 x1 - 3 x2 + u is the equation of a unit mass
            ([[-2, -3], [1, 0]], ["x1", "x2"], {"x2": "mechanical"}),
            # a lagged actuator behind a free mass, and a motor without friction
            ([[0, 1, 0], [0, 0, 1], [0, 0, -5.0]], ["x", "v", "a"], {"x": "mechanical", "a": "first_order"}),
            (
                [[0, 1, 0], [0, 0, 4.0], [0, -2.0, -10.0]],
                ["angle", "speed", "current"],
                {"angle": "mechanical", "current": "first_order"},
            ),
        ],
    )
    def test_displacements_of_actuated_masses_are_found(self, A, states, expected):
        n = len(A)
        B = np.eye(n)[:, :1] if n == 2 else 20 * np.eye(n)[:, -1:]
        found = rco.ports(ct.ss(A, B, np.eye(n)[:1], 0, states=states))
        assert {port.name: port.kind for port in found} == expected

    def test_similarity_transformation_hides_the_displacements(self, rng):
        sys = chain()
        T = rng.normal(size=(4, 4))
        transformed = ct.ss(T @ sys.A @ np.linalg.inv(T), T @ sys.B, sys.C @ np.linalg.inv(T), 0)
        assert kinds(transformed) == ["first_order"] * 4
        assert [port.name for port in rco.ports(transformed)] == ["x[0]", "x[1]", "x[2]", "x[3]"]

    def test_motor_of_first_order(self):
        port = rco.ports(ct.ss(-1 / 0.28, 35 / 0.28, 1, 0, states=["rpm"], inputs=["volts"]))[0]
        assert (port.name, port.kind) == ("rpm", "first_order")
        np.testing.assert_allclose(port.act, [-35 / 0.28])  # forces in volts

    def test_thermal_network_has_an_exchange(self):
        C1, C2, R, Ra = 10.0, 40.0, 0.5, 2.0
        A = [[-1 / (R * C1), 1 / (R * C1)], [1 / (R * C2), -1 / (R * C2) - 1 / (Ra * C2)]]
        sys = ct.ss(A, [[1 / C1], [0]], [[0, 1]], 0, states=["T1", "T2"], inputs="heat")
        found = {port.name: port for port in rco.ports(sys)}
        assert list(found) == ["T1", "T2", "T1-T2"]
        np.testing.assert_allclose(found["T1-T2"].act, [-1 / C1, 1 / C2])
        np.testing.assert_allclose(found["T1-T2"].velocity, [1, -1])
        np.testing.assert_allclose(found["T2"].act, [0, -1 / C2])

    def test_cascade_of_tanks_has_a_flow(self):
        A1, A2, k1, k2 = 2.0, 4.0, 0.5, 0.25
        sys = ct.ss([[-k1 / A1, 0], [k1 / A2, -k2 / A2]], [[1 / A1], [0]], [[0, 1]], 0, states=["h1", "h2"])
        flow = rco.PhysicalModel.from_statespace(sys).port("h1->h2")
        np.testing.assert_allclose(flow.act, [-1 / A1, 1 / A2])
        np.testing.assert_allclose(flow.velocity, [1, 0])


class TestAccelerometers:
    @staticmethod
    def model(C, D=0.0, A=None, B=None):
        A = state_matrix(CHAIN_M, CHAIN_C, CHAIN_K) if A is None else A
        B = np.array([[0.0], [0.0], [1 / 0.8], [0.0]]) if B is None else B
        return rco.PhysicalModel.from_statespace(ct.ss(A, B, np.atleast_2d(C), np.atleast_2d(D)))

    def test_force_feeds_through(self):
        A = state_matrix(CHAIN_M, CHAIN_C, CHAIN_K)
        model = self.model(A[2], 1 / 0.8)
        np.testing.assert_allclose(model.output_rate, [[0, 0, 1, 0]])
        np.testing.assert_allclose(model.output_input, [[0]], atol=1e-12)

    def test_mean_of_two_accelerometers_with_sensitivity(self):
        A = state_matrix(CHAIN_M, CHAIN_C, CHAIN_K)
        row = 2.5 * A[2] - 1.5 * A[3]
        np.testing.assert_allclose(self.model(row, 2.5 / 0.8).output_rate, [[0, 0, 2.5, -1.5]])

    @pytest.mark.parametrize("C", [[1, 0, 0, 0], [0, 0, 0, 1], [1, -1, 0, 0], [0.3, 0, 0, 2]])
    def test_displacements_and_velocities_stay(self, C):
        model = self.model(C)
        assert not model.output_rate.any()
        np.testing.assert_array_equal(model.output_state, [C])

    def test_undamped_model_where_displacements_are_combinations_of_accelerations(self):
        A = state_matrix(CHAIN_M, np.zeros((2, 2)), CHAIN_K)
        for C in ([1.0, 0, 0, 0], [0, 1, 0, 0], [1, -1, 0, 0], [-3, 3, 0, 0]):
            assert not self.model(C, A=A).output_rate.any()
        np.testing.assert_allclose(self.model(A[3], A=A).output_rate, [[0, 0, 0, 1]], atol=1e-12)

    def test_free_pair_reads_the_mass_that_feels_the_force(self):
        # the rows of the two masses are parallel: only D tells them apart
        K = np.array([[5.0, -5.0], [-5.0, 5.0]])
        A = state_matrix(np.diag([1.0, 2.0]), 0.01 * K, K)
        B = np.array([[0.0], [0], [1], [0]])
        np.testing.assert_allclose(self.model(A[2], 1.0, A, B).output_rate, [[0, 0, 1, 0]])
        np.testing.assert_allclose(self.model(A[3], 0.0, A, B).output_rate, [[0, 0, 0, 1]])

    def test_output_is_always_split_exactly(self, rng):
        A = state_matrix(CHAIN_M, CHAIN_C, CHAIN_K)
        C = np.vstack([A[2], rng.normal(size=4), A[3], [0, 1, 0, 0]])
        model = self.model(C, [[1.25], [0], [0], [0]])
        linear = model.linear
        np.testing.assert_allclose(model.output_state + model.output_rate @ linear.A, C, atol=1e-9)
        np.testing.assert_allclose(model.output_input + model.output_rate @ linear.B, linear.D, atol=1e-9)


class TestTimebase:
    def test_sampled_model_is_converted(self):
        sampled = ct.c2d(chain(), 1e-3)
        model = rco.PhysicalModel.from_statespace(sampled)
        assert model.linear.is_continuous
        plain = values(rco.PhysicalModel.from_statespace(chain()))
        found = values(model)
        for name, value in plain.items():
            assert found[name] == pytest.approx(value, rel=1e-5)
        assert found.keys() == plain.keys()

    def test_unspecified_sampling_time(self):
        sampled = ct.c2d(chain(), 1e-3)
        unspecified = ct.ss(sampled.A, sampled.B, sampled.C, sampled.D, True)
        with pytest.raises(rco.ModelError, match="no sampling time"):
            rco.ports(unspecified)
        assert [port.kind for port in rco.ports(unspecified, dt=1e-3)] == ["mechanical"] * 3

    def test_static_gain_has_no_ports(self):
        model = rco.PhysicalModel.from_statespace(ct.ss([], [], [], [[2.0]]))
        assert model.ports == ()
        assert "0 states, 1 input, 1 output" in str(model)

    def test_no_timebase_counts_as_continuous(self):
        sys = chain()
        assert len(rco.ports(ct.ss(sys.A, sys.B, sys.C, sys.D, None))) == 3


class TestPhysicalModel:
    def test_wrong_type_says_what_to_do(self):
        with pytest.raises(ct.ControlArgument, match=r"StateSpace, not FrequencyResponseData"):
            rco.ports(ct.frd([1.0, 0.5], [1.0, 2.0]))

    def test_unknown_port_lists_those_that_exist(self):
        with pytest.raises(rco.ModelError, match="x1, x2, x1-x2"):
            as_physical(chain()).port("x3")

    def test_entry_by_number_and_label(self):
        model = as_physical(chain())
        assert model.entry("A[2,0]") == model.entry("A[v1,x1]") == (2, 0)
        plain = as_physical(chain(states=["x[0]", "x[1]", "x[2]", "x[3]"]))
        assert plain.entry("A[x[2],x[0]]") == plain.entry("A[2, 0]") == (2, 0)
        assert model.entry("B[v1,f]") == (2, 4)
        assert model.entry("C[y,x1]") == model.entry("C[0,0]") == (4, 0)
        assert model.entry("D[0,0]") == (4, 4)
        for wrong in ("A[4,0]", "A[0]", "B[0,1]", "A[u,v]", "E[0,0]", "C[x1,y]"):
            with pytest.raises(rco.ModelError, match="no entry of the model"):
                model.entry(wrong)

    def test_pickle(self):
        model = pickle.loads(pickle.dumps(as_physical(chain())))
        np.testing.assert_array_equal(model.system.A, chain().A)
        assert [port.name for port in model.ports] == ["x1", "x2", "x1-x2"]
        with pytest.raises(ValueError, match="read-only"):
            model.ports[0].act[0] = 1.0

    def test_as_physical_takes_what_holds_a_model(self):
        model = as_physical(chain())

        class Holder:
            physical_model = model

        assert as_physical(Holder()) is model
        assert as_physical(model) is model

    def test_system_is_built_anew(self):
        model = as_physical(chain())
        system = model.system
        system.A[0, 0] = 99.0
        np.testing.assert_array_equal(model.system.A, chain().A)
        assert model.system.state_labels == ["x1", "x2", "v1", "v2"]

    def test_text_fits_a_terminal(self):
        text = str(as_physical(chain()))
        assert max(map(len, text.splitlines())) <= 80
        assert "k[x1-x2] = 25000" in text

    def test_split_that_does_not_add_up(self):
        model = as_physical(chain())
        with pytest.raises(rco.ModelError, match="is not its row of output_state"):
            rco.PhysicalModel(
                model.linear, model.output_state * 2, model.output_rate, model.output_input, model.ports
            )

    def test_port_checks(self):
        with pytest.raises(rco.ModelError, match="kind of port"):
            rco.Port("a", "thermal", act=[1.0], position=[0.0], velocity=[1.0])
        with pytest.raises(ct.ControlDimension, match="velocity of port 'a'"):
            rco.Port("a", "mechanical", act=[1.0, 0.0], position=[0.0, 1.0], velocity=[1.0])
        with pytest.raises(rco.ModelError, match="not finite"):
            rco.Port("a", "mechanical", act=[np.nan], position=[0.0], velocity=[1.0])
        port = rco.Port("a", "mechanical", act=[-1.0], position=[0.0], velocity=[1.0])
        linear = as_physical(chain()).linear
        with pytest.raises(ct.ControlDimension, match="1 states"):
            rco.PhysicalModel(linear, linear.C, 0 * linear.C, linear.D, (port,))


@pytest.mark.parametrize(
    ("unit", "read"),
    [
        ("K", ("displacement", "temperature")),
        ("V", ("displacement", "voltage")),
        ("", ("displacement", "state")),
        ("A", ("charge", "current")),
    ],
)
def test_what_a_store_shows_is_called_as_its_field_calls_it(unit, read):
    """A temperature is no velocity."""
    store = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, states=["x"], inputs=["u"], outputs=["y"])
    assert rco.physical(store, units={"x": unit} if unit else {}).port("x").senses == read
