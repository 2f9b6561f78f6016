"""Links found in the matrices of a plain model, and those that are declared."""

import control as ct
import numpy as np
import pytest

import rcorefine as rco

GEAR = np.array([1 / 5, -1.0])
HALF_CAR = {"front": [1, -1.2, -1, 0], "rear": [1, 1.5, 0, -1]}
NODES = np.array([[0, 0], [0, 1], [1, 0], [1, 1.1], [2.1, 0], [2, 1.0]])
BARS = [(0, 2), (1, 3), (0, 3), (1, 2), (2, 3), (2, 4), (3, 5), (2, 5), (3, 4), (4, 5)]


def plain(m, K, C, labels, force=0):
    n = len(m)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-K / m[:, None], -C / m[:, None]]])
    B = np.zeros((2 * n, 1))
    B[n + force] = 1 / m[force]
    states = [*labels, *(f"d{label}" for label in labels)]
    return ct.ss(A, B, np.eye(2 * n)[:1], 0, states=states, inputs=["f"], outputs=["y"])


def assembled(directions, sizes):
    return sum(k * np.outer(g, g) for g, k in zip(np.array(directions, float), sizes, strict=True))


def gear():
    C = assembled([GEAR], [0.4]) + np.diag([0.004, 0.1])
    return plain(np.array([0.01, 0.3]), assembled([GEAR], [120.0]), C, ["th1", "th2"])


def half_car():
    g = list(HALF_CAR.values())
    K = assembled(g, [18e3, 22e3]) + np.diag([0, 0, 170e3, 180e3])
    C = assembled(g, [1e3, 1.2e3])
    return plain(np.array([600.0, 800.0, 35.0, 40.0]), K, C, ["z", "theta", "zf", "zr"], force=2)


def bars(free):
    found = []
    for a, b in BARS:
        cosines = (NODES[b] - NODES[a]) / np.linalg.norm(NODES[b] - NODES[a])
        g = np.zeros(2 * len(free))
        for node, sign in ((a, -1), (b, 1)):
            if node in free:
                at = 2 * free.index(node)
                g[at : at + 2] = sign * cosines
        found.append(g)
    return found


def truss(dampers):
    """Two bays with crossed diagonals; each node on the wall side hangs on two oblique bars or one."""
    free, rng = [2, 3, 4, 5], np.random.default_rng(0)
    g, k = bars(free), rng.uniform(800, 1200, len(BARS))
    K = assembled(g, k)
    C = assembled(g, 1e-3 * k * rng.uniform(0.5, 1.5, len(BARS))) if dampers else 1e-3 * K
    labels = [f"{axis}{node}" for node in free for axis in "xy"]
    return plain(np.repeat(rng.uniform(0.8, 1.2, 4), 2), K, C, labels), g, k


def link_rows(model):
    """Directions on the displacements of all ports that join several, in the order of the states' names."""
    states = model.linear.state_labels
    order = sorted(range(len(states)), key=states.__getitem__)
    return [port.position[order] for port in model.ports if np.count_nonzero(port.position) > 1]


def holds(rows, g, atol=1e-6):
    g = g / np.linalg.norm(g)
    return any(abs(abs(row @ g) / np.linalg.norm(row) - 1) < atol for row in rows)


def transformed(sys, T):
    """The same system in the states T x, under the same names."""
    T = np.asarray(T, float)
    inverse = np.linalg.inv(T)
    return ct.ss(
        T @ sys.A @ inverse, T @ sys.B, sys.C @ inverse, sys.D,
        states=sys.state_labels, inputs=sys.input_labels, outputs=sys.output_labels,
    )  # fmt: skip


def permuted(sys, order):
    return ct.ss(
        sys.A[np.ix_(order, order)], sys.B[order], sys.C[:, order], sys.D,
        states=[sys.state_labels[i] for i in order], inputs=sys.input_labels, outputs=sys.output_labels,
    )  # fmt: skip


def rounded(X, digits=4):
    return np.array([[float(f"{x:.{digits - 1}e}") for x in row] for row in X])


def truths(sys, directions):
    """Directions on all states, in the order of their names."""
    order = sorted(range(sys.nstates), key=sys.state_labels.__getitem__)
    n = sys.nstates // 2
    return [np.concatenate([g, np.zeros(n)])[order] for g in directions if np.count_nonzero(g) > 1]


CASES = {
    "gear": (gear, [GEAR]),
    "half car": (half_car, list(HALF_CAR.values())),
    "truss": (lambda: truss(True)[0], bars([2, 3, 4, 5])),
}


class TestFound:
    def test_gear(self):
        model = rco.PhysicalModel.from_statespace(gear())
        assert [port.name for port in model.ports] == ["th1", "th2", "0.2*th1-th2"]
        found = {q.name: q.value for q in model.parameters}
        assert found == pytest.approx(
            {"k[0.2*th1-th2]": 120, "c[0.2*th1-th2]": 0.4, "c[th1]": 0.004, "c[th2]": 0.1, "gain[f]": 1}
        )
        port = model.port("0.2*th1-th2")
        np.testing.assert_allclose(port.act, [0, 0, -0.2 / 0.01, 1 / 0.3])
        np.testing.assert_allclose(port.velocity, [0, 0, 0.2, -1])

    def test_half_car(self):
        model = rco.PhysicalModel.from_statespace(half_car())
        names = [port.name for port in model.ports]
        assert names == ["z", "theta", "zf", "zr", "z-1.2*theta-zf", "z+1.5*theta-zr"]
        found = {q.name: q.value for q in model.parameters}
        assert found["k[z-1.2*theta-zf]"] == pytest.approx(18e3)
        assert found["c[z+1.5*theta-zr]"] == pytest.approx(1.2e3)
        assert found["k[zf]"] == pytest.approx(170e3)

    def test_truss_with_dampers_is_known_to_the_last_bar(self):
        sys, g, k = truss(dampers=True)
        model = rco.PhysicalModel.from_statespace(sys)
        for direction, size in zip(g, k, strict=True):
            full = np.concatenate([direction, np.zeros(8)])
            row = next(p for p in model.ports if holds([p.position], full))
            value = next(q.value for q in model.parameters if (q.place, q.kind) == (row.name, "stiffness"))
            assert value * (row.position @ row.position) == pytest.approx(size * (full @ full), rel=1e-6)

    def test_truss_with_proportional_damping_says_what_stays_open(self):
        sys, g, _ = truss(dampers=False)
        model = rco.PhysicalModel.from_statespace(sys)
        rows = link_rows(model)
        for (a, b), truth in zip(BARS, g, strict=True):
            full = truths(sys, [truth])
            if a >= 2 and b >= 2:
                assert holds(rows, full[0])
        assert "physical(system, links=...)" in model.port("x2").description
        assert "physical(system" not in model.port("x4").description

    def test_rayleigh_damping_decides_no_direction(self):
        """Its matrix has the principal axes of each joint, which are no bars."""
        sys, g, k = truss(dampers=False)
        masses, K = np.random.default_rng(1).uniform(0.8, 1.2, 4).repeat(2), assembled(g, k)
        model = rco.physical(plain(masses, K, 0.2 * np.diag(masses) + 1e-3 * K, sys.state_labels[:8]))
        links = [port for port in model.ports if np.count_nonzero(port.position) > 1]
        assert len(links) == 12
        for port in links:
            is_bar = any(holds([port.position[:8]], bar) for bar in g)
            assert is_bar or "physical(system, links=...)" in port.description

    @pytest.mark.parametrize("bar", range(len(BARS)))
    def test_a_change_of_any_bar_is_a_sum_of_places(self, bar):
        """Also of an oblique bar to the ground whose direction stays open."""
        sys, g, _ = truss(dampers=False)
        model = rco.physical(sys)
        change = np.outer(g[bar], g[bar]).ravel()
        springs = {q.place for q in model.parameters if q.kind == "stiffness"}
        rows = [port.position[:8] for port in model.ports if port.name in springs]
        columns = np.array([np.outer(row, row).ravel() for row in rows]).T
        found = np.linalg.lstsq(columns, change, rcond=None)[0]
        np.testing.assert_allclose(columns @ found, change, atol=1e-9)
        ends = {2 * (i // 2) + axis for i in np.flatnonzero(g[bar]) for axis in (0, 1)}
        for row, size in zip(rows, found, strict=True):
            assert abs(size) < 1e-9 or set(np.flatnonzero(row)) <= ends

    def test_heave_and_pitch_need_dampers_of_another_ratio(self):
        g = [[1, -1.2], [1, 1.5]]
        m = np.array([600.0, 800.0])
        K = assembled(g, [18e3, 22e3])
        known = plain(m, K, assembled(g, [1e3, 1.8e3]), ["z", "theta"])
        assert all(holds(link_rows(rco.physical(known)), row) for row in truths(known, np.array(g)))
        model = rco.physical(plain(m, K, 0.05 * K, ["z", "theta"]))
        assert [port.name for port in model.ports] == ["z", "theta"]
        assert "links=" in model.port("theta").description

    def test_gear_on_a_spring_has_no_certain_ratio(self):
        K = assembled([GEAR], [120.0]) + np.diag([0, 50.0])
        sys = plain(np.array([0.01, 0.3]), K, 1e-3 * K, ["th1", "th2"])
        assert [port.name for port in rco.ports(sys)] == ["th1", "th2"]

    def test_differential_is_one_link_of_three(self):
        g = np.array([1.0, 1.0, -2.0])
        K = assembled([g], [40.0])
        C = assembled([g], [0.1]) + np.diag([0.01, 0.02, 0.03])
        sys = plain(np.array([0.1, 0.2, 0.3]), K, C, ["a1", "a2", "a3"])
        assert [port.name for port in rco.ports(sys)][3:] == ["a1+a2-2*a3"]

    def test_twist_behind_a_gear_as_a_state(self):
        N, k, J1, J2 = 4.0, 80.0, 0.02, 0.5
        A = [[0, 1 / N, -1], [-k / N / J1, -0.3, 0], [k / J2, 0, -0.2]]
        sys = ct.ss(A, [[0], [1 / J1], [0]], [[0, 1, 0]], 0, states=["twist", "w1", "w2"], inputs=["T"])
        port = rco.physical(sys).port("twist")
        np.testing.assert_allclose(port.velocity, [0, 1 / N, -1])
        np.testing.assert_allclose(port.act, [0, -1 / J1, N / J2])  # for a force in units of d' / w1

    def test_motor_current_is_no_displacement(self):
        # angle, speed, current of a motor that drives a load through a gear
        full = np.zeros((5, 5))
        full[:4, :4] = gear().A
        full[2, 4], full[4, 2], full[4, 4] = 5.0, -0.1 / 2e-3, -500.0
        sys = ct.ss(full, np.eye(5)[:, 4:] / 2e-3, np.eye(5)[:1], 0, states=[*gear().state_labels, "i"])
        found = {port.name: port for port in rco.ports(sys)}
        assert set(found) == {"th1", "th2", "i", "0.2*th1-th2"}
        assert found["i"].kind == "first_order"

    def test_lengths_and_angles_are_not_subtracted(self):
        K = np.array([[300.0, -100.0], [-100.0, 200.0]])
        sys = plain(np.ones(2), K, 1e-3 * K, ["z", "theta"])
        assert [port.name for port in rco.ports(sys)] == ["z", "theta"]
        units = {"a": "m", "b": "rad"}
        other = plain(np.ones(2), K, 1e-3 * K, ["a", "b"])
        assert [port.name for port in rco.ports(other)] == ["a", "b", "a-b"]
        assert [port.name for port in rco.physical(other, units=units).ports] == ["a", "b"]


class TestInvariance:
    @pytest.mark.parametrize("case", CASES)
    def test_order_of_states(self, case, rng):
        make, g = CASES[case]
        sys = make()
        model = rco.physical(permuted(sys, rng.permutation(sys.nstates).tolist()))
        rows = link_rows(model)
        assert all(holds(rows, row) for row in truths(sys, g))
        assert len(rows) == len(truths(sys, g))

    @pytest.mark.parametrize("case", CASES)
    def test_four_digits(self, case):
        make, g = CASES[case]
        sys = make()
        A = rounded(sys.A)
        model = rco.physical(ct.ss(A, sys.B, sys.C, sys.D, states=sys.state_labels))
        rows = link_rows(model)
        assert all(holds(rows, row, atol=2e-3) for row in truths(sys, g))
        assert not any(q.kind == "coefficient" for q in model.parameters)

    @pytest.mark.parametrize("case", CASES)
    def test_sense_of_states(self, case, rng):
        make, g = CASES[case]
        sys = make()
        n = sys.nstates // 2
        sign = rng.choice([-1.0, 1.0], n)
        model = rco.physical(transformed(sys, np.diag(np.concatenate([sign, sign]))))
        rows = link_rows(model)
        assert all(holds(rows, row) for row in truths(sys, [sign * np.array(one) for one in g]))

    @pytest.mark.parametrize("case", ["gear", "half car"])
    def test_units_of_states(self, case, rng):
        make, g = CASES[case]
        sys = make()
        n = sys.nstates // 2
        position, speed = 10.0 ** rng.uniform(-1, 1, n), 10.0 ** rng.uniform(-1, 1, n)
        model = rco.physical(transformed(sys, np.diag(np.concatenate([position, speed]))))
        rows = link_rows(model)
        assert all(holds(rows, row) for row in truths(sys, [np.array(one) / position for one in g]))

    def test_sense_of_one_mass_in_a_chain(self):
        m, k = np.array([0.8, 0.5, 0.7]), [300.0, 200.0, 100.0]
        g = np.array([[1, 0, 0], [-1, 1, 0], [0, -1, 1.0]])
        sys = plain(m, assembled(g, k), assembled(g, [1.0, 2.0, 3.0]), ["x1", "x2", "x3"])
        sign = np.diag([1.0, -1, 1, 1, -1, 1])
        assert [p.name for p in rco.ports(transformed(sys, sign))][3:] == ["x1+x2", "x2+x3"]


class TestDeclared:
    def test_a_declared_link_takes_the_place_of_the_found_one(self):
        model = rco.physical(gear(), links={"shaft": {"th1": 1 / 5, "th2": -1}})
        assert [port.name for port in model.ports] == ["th1", "th2", "shaft"]
        found = {q.name: q.value for q in model.parameters}
        assert found["k[shaft]"] == pytest.approx(120)
        assert found["c[shaft]"] == pytest.approx(0.4)

    def test_weights_may_have_any_size(self):
        whole = rco.physical(gear(), links={"shaft": {"th1": 1.0, "th2": -5.0}})
        found = {q.name: q.value for q in whole.parameters}
        assert found["k[shaft]"] == pytest.approx(120 / 25)  # d is five times as large
        port = whole.port("shaft")
        np.testing.assert_allclose(found["k[shaft]"] * np.outer(port.act, port.position)[2:, :2],
                                   -np.diag([100, 1 / 0.3]) @ assembled([GEAR], [120.0]))  # fmt: skip

    def test_the_rest_of_an_open_truss(self):
        sys, g, k = truss(dampers=False)
        labels = sys.state_labels[:8]
        links = {
            f"bar{a}{b}": {label: w for label, w in zip(labels, g[BARS.index((a, b))], strict=True) if w}
            for a, b in BARS if (a < 2) and np.count_nonzero(g[BARS.index((a, b))]) > 1
        }  # fmt: skip
        model = rco.physical(sys, links=links)
        for (a, b), size in zip(BARS, k, strict=True):
            if f"bar{a}{b}" in links:
                value = next(q.value for q in model.parameters if q.name == f"k[bar{a}{b}]")
                assert value == pytest.approx(size, rel=1e-6)
        assert not any("links=" in port.description for port in model.ports)

    def test_gear_with_a_spring_at_the_load(self):
        K = assembled([GEAR], [120.0]) + np.diag([0, 50.0])
        sys = plain(np.array([0.01, 0.3]), K, 1e-3 * K, ["th1", "th2"])
        model = rco.physical(sys, links={"shaft": {"th1": 1 / 5, "th2": -1}})
        found = {q.name: q.value for q in model.parameters}
        assert found["k[shaft]"] == pytest.approx(120)
        assert found["k[th2]"] == pytest.approx(50)

    def test_flow_between_stores(self):
        A = [[-0.3, 0.0], [0.2, -0.4]]
        sys = ct.ss(A, [[1], [0]], [[0, 1]], 0, states=["h1", "h2"], inputs=["q"])
        port = rco.physical(sys, links={"pipe": {"h1": 1, "h2": -1}}, units={"h1": "m", "h2": "m"}).port(
            "pipe"
        )
        assert (port.kind, port.velocity_unit) == ("first_order", "m")
        np.testing.assert_allclose(port.velocity, [1, -1])
        np.testing.assert_allclose(port.act, [-1, 1])

    def test_road_as_the_other_end(self):
        model = rco.physical(half_car(), links={"tire": {"zf": 1, "f": -1}})
        tire = model.port("tire")
        np.testing.assert_allclose(tire.position_input, [-1])
        assert not tire.has_velocity  # the rate of an input stands in no matrix

    def test_mass_and_units(self):
        sys = ct.ss([[0, 1], [-4, -1]], [[0], [3]], [[1, 0]], 0, states=["q", "v"], inputs=["u"])
        model = rco.physical(sys, parameters={"m": ("mass", "q", 2.0)}, units={"q": "m", "u": "V"})
        found = {q.name: q.value for q in model.parameters}
        assert found["m"] == 2.0
        assert found["k[q]"] == pytest.approx(8.0)
        assert found["c[q]"] == pytest.approx(2.0)
        assert (model.port("q").position_unit, model.port("q").velocity_unit) == ("m", "m/s")
        assert model.input_units == ("V",)

    def test_a_builders_model_takes_links_too(self):
        chain = rco.mass_spring_damper([1.0, 2.0], [0.1, 0.1], [10.0, 20.0])
        label = chain.linear.state_labels[0]
        model = rco.physical(chain, links={"brace": {label: 2.0}})
        np.testing.assert_allclose(model.port("brace").position[:2], [2, 0])

    @pytest.mark.parametrize(
        ("keys", "message"),
        [
            ({"links": {"s": {"th3": 1.0}}}, r"link 's' names 'th3', which is neither a state \(th1"),
            ({"links": {"s": {"th1": 0.0}}}, "link 's' needs a name, and states with weights"),
            (
                {"links": {"s": {"th1": 1.0, "dth2": 1.0}}},
                "adds th1, dth2, which are not of one sort",
            ),
            ({"links": {"s": {"f": 1.0}}}, "link 's' joins inputs alone"),
            ({"units": {"x": "m"}}, "units names 'x', which is no signal; there are th1"),
            ({"parameters": {"k": ("stiffness", "belt", 1.0)}}, "parameter 'k': .* no port 'belt'"),
            ({"parameters": {"k": ("clearance", "th1", 1.0)}}, "parameter 'k' cannot be of kind 'clearance'"),
            ({"links": {"th1": {"th1": 1.0, "th2": -1.0}}}, "must be unique"),
        ],
    )
    def test_errors_name_the_link_and_the_remedy(self, keys, message):
        with pytest.raises(rco.ModelError, match=message):
            rco.physical(gear(), **keys)

    def test_a_file_declares_links(self, tmp_path):
        sys = gear()
        lines = ["[state_space]", *(f"{k} = {getattr(sys, k).tolist()}" for k in "ABCD")]
        lines += [f"states = {sys.state_labels}", 'inputs = ["f"]', 'outputs = ["y"]']
        lines += ['units = {th1 = "rad", th2 = "rad"}', 'parameters = {J1 = ["mass", "th1", 0.02]}']
        lines += ["[state_space.links]", "shaft = {th1 = 0.2, th2 = -1.0}"]
        path = tmp_path / "drive.toml"
        path.write_text("\n".join(lines))
        model = rco.read_model(path)
        assert model.port("shaft").position_unit == "rad"
        assert {q.name: q.value for q in model.parameters}["k[shaft]"] == pytest.approx(240)
        path.write_text("\n".join(lines).replace("th2 = -1.0}", "th9 = -1.0}"))
        with pytest.raises(rco.ModelError, match="drive.toml.*link 'shaft' names 'th9'"):
            rco.read_model(path)

    def test_declared_links_are_candidates(self):
        model = rco.physical(gear(), links={"shaft": {"th1": 1 / 5, "th2": -1}})
        kinds = {effect.kind for effect in rco.effect_library(model, places="shaft")}
        assert {"stiffness", "clearance", "coulomb_friction"} <= kinds
        assert "mass" not in kinds


class TestModes:
    W, ZETA = np.array([3.0, 7.0, 12.0]), np.array([0.01, 0.02, 0.015])
    PHI = np.array([[0.8, 0.5, -0.3], [0.2, -0.7, 0.6]])  # at the force, at the sensor

    def oscillators(self):
        n, W, ZETA = 3, self.W, self.ZETA
        A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(W**2), -np.diag(2 * ZETA * W)]])
        B, C = np.zeros((2 * n, 1)), np.zeros((1, 2 * n))
        B[n:, 0], C[0, :n] = self.PHI
        return ct.ss(A, B, C, 0, states=[f"q{i}" for i in range(n)] + [f"dq{i}" for i in range(n)])

    def rotations(self, rng):
        """The same system in blocks [[s, w], [-w, s]], each turned by an angle of its own."""
        T = np.zeros((6, 6))
        for i, (w, zeta) in enumerate(zip(self.W, self.ZETA, strict=True)):
            s, wd = -zeta * w, w * np.sqrt(1 - zeta**2)
            angle = rng.uniform(0, 2 * np.pi)
            turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            T[2 * i : 2 * i + 2, [i, 3 + i]] = turn @ np.array([[1.0, 0.0], [-s / wd, 1 / wd]])
        return transformed(self.oscillators(), T)

    def test_frequencies_and_dampings(self, rng):
        for sys in (self.oscillators(), self.rotations(rng)):
            model = rco.physical(sys)
            assert len(model.ports) == 3
            found = {kind: sorted(q.value for q in model.parameters if q.kind == kind) for kind in
                     ("stiffness", "damping", "coefficient", "mass")}  # fmt: skip
            assert found["stiffness"] == pytest.approx(self.W**2)
            assert found["damping"] == pytest.approx(sorted(2 * self.ZETA * self.W))
            weights = {q.name[0] for q in model.parameters if q.kind == "coefficient"}
            assert weights <= {"B", "C"}  # how its modes are driven and seen
            assert not found["mass"]
            kinds = {e.kind for e in rco.effect_library(model) if e.place in {p.name for p in model.ports}}
            assert kinds == {"stiffness", "damping"}

    def test_change_of_stiffness_moves_the_frequency_alone(self, rng):
        for sys in (self.oscillators(), self.rotations(rng)):
            for port in rco.ports(sys):
                A = sys.A + 0.5 * np.outer(port.act, port.position)
                assert np.trace(A) == pytest.approx(np.trace(sys.A))
                old, new = (np.sort(np.linalg.eigvals(X).imag ** 2 + np.linalg.eigvals(X).real ** 2)[::2]
                            for X in (sys.A, A))  # fmt: skip
                np.testing.assert_allclose(np.sort(new - old), [0, 0, 0.5], atol=1e-9)
                # and the refined model is one in modal coordinates again, with the same modal mass
                v = sys.A + 0.1 * np.outer(port.act, port.velocity)
                assert np.trace(v) == pytest.approx(np.trace(sys.A) - 0.1)

    def test_masses_of_their_own_are_no_modes(self):
        sys = self.oscillators()
        apart = ct.ss(sys.A, sys.B, np.eye(6)[:3], 0, states=sys.state_labels)
        assert "clearance" in {e.kind for e in rco.effect_library(apart, places="q0")}

    def test_outputs_do_not_change_with_the_coordinates(self, rng):
        """A change of stiffness is the same system in both, to first order and beyond."""
        one, two = self.oscillators(), self.rotations(rng)
        s = 1j * np.linspace(1, 15, 40)
        changed = []
        for sys in (one, two):
            port = min(rco.ports(sys), key=lambda p: float(p.description.split()[2]))
            A = sys.A + 0.5 * np.outer(port.act, port.position)
            changed.append([complex((sys.C @ np.linalg.solve(x * np.eye(6) - A, sys.B))[0, 0]) for x in s])
        np.testing.assert_allclose(changed[0], changed[1], rtol=1e-9)


class TestRateThroughTheInput:
    def test_road_velocity(self):
        """The velocity across a tire is that of the wheel minus an input."""
        ms, mu, ks, cs, kt = 250.0, 35.0, 16e3, 1e3, 160e3
        A = [
            [0, 1, 0, -1],
            [-ks / ms, -cs / ms, 0, cs / ms],
            [0, 0, 0, 1],
            [ks / mu, cs / mu, -kt / mu, -cs / mu],
        ]
        sys = ct.ss(A, [[0], [0], [-1], [0]], [[1, 0, 0, 0]], 0, states=["susp", "vs", "tire", "vu"])
        tire = rco.physical(sys).port("tire")
        np.testing.assert_allclose(tire.velocity, [0, 0, 0, 1])
        np.testing.assert_allclose(tire.velocity_input, [-1])

    def test_a_declared_end_that_is_an_input(self):
        sys = ct.ss([[-2.0]], [[1.0]], [[1.0]], 0, states=["v"], inputs=["belt"])
        port = rco.physical(sys, links={"slip": {"v": 1, "belt": -1}}).port("slip")
        np.testing.assert_allclose(port.velocity_input, [-1])


class TestLadder:
    def test_branches_and_shunts(self):
        """Two inductors and two capacitors without losses: L i' = v - v', C v' = i - i'."""
        L, C = [0.5, 0.8], [0.1, 0.2]
        A = np.zeros((4, 4))
        A[0, 2], A[1, 2], A[1, 3] = -1 / L[0], 1 / L[1], -1 / L[1]
        A[2, 0], A[2, 1], A[3, 1] = 1 / C[0], -1 / C[0], 1 / C[1]
        labels = ["i1", "i2", "v1", "v2"]
        sys = ct.ss(A, [[1 / L[0]], [0], [0], [0]], np.eye(4)[3:], 0, states=labels, inputs=["u"])
        found = {port.name: port for port in rco.ports(sys)}
        assert set(found) == {"v1", "v2", "shunt v1", "shunt v2", "i1"}  # the branch of i2 is v2
        np.testing.assert_allclose(found["shunt v1"].act, [0, 0, -1 / C[0], 0])
        np.testing.assert_allclose(found["shunt v2"].act, [0, 0, 0, -1 / C[1]])
        np.testing.assert_allclose(found["i1"].act, [-1 / L[0], 0, 0, 0])
        assert "threshold_flow" in {e.kind for e in rco.effect_library(sys, places="shunt v1")}


def test_a_link_of_one_displacement_goes_to_the_ground():
    chain = ct.ss(
        [[0, 0, 1, 0], [0, 0, 0, 1], [-9, 4, -0.3, 0.1], [8, -8, 0.2, -0.2]], [[0], [0], [1], [0]],
        [[1, 0, 0, 0]], [[0]], states=["a", "b", "va", "vb"],
    )  # fmt: skip
    port = rco.physical(chain, links={"wall": {"a": 1.0}}).port("wall")
    np.testing.assert_allclose(port.position, [1, 0, 0, 0])
    np.testing.assert_allclose(port.velocity, [0, 0, 1, 0])
    assert port.act[2] < 0
    assert np.count_nonzero(port.act) == 1
    assert port.description.startswith("at a")
