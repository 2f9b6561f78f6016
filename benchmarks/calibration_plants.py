"""Plants, laws and nuisances that no test has; a Runge-Kutta method that shares no code with the package."""

from __future__ import annotations

import inspect

import control as ct
import numpy as np
from scipy.signal import lfilter

import rcorefine as rco

try:
    from numba import njit
except ImportError:

    def njit(function):  # without numba it takes minutes a record
        return function


@njit
def law(k, d, v, z, t, a, b, p):
    """Force by its number; a and b are the rms of d and v without it."""
    if k == 1:
        return np.tanh(v / (0.002 * b))
    if k == 2:
        return d**3 / a**2
    if k == 3:
        return v * abs(v) / b
    if k == 4:
        return np.sign(d) * max(abs(d) - p * a, 0.0)
    if k == 5:
        return max(d - p * a, 0.0)
    if k == 6:
        return np.tanh(v / (0.002 * b)) * (1 + 0.9 * np.exp(-((v / (0.25 * b)) ** 2)))
    if k == 7:
        return d
    if k == 8:
        return v
    if k == 9:
        return max(d, 0.0)
    if k == 10:
        return np.sin(2.7 * d / a)
    if k == 11:
        return np.sign(v) * (abs(v) / b) ** 1.5
    if k == 12:
        return z
    if k == 13:
        return d * t
    if k == 14:
        return v**3 / b**2
    if k == 15:
        return v * max(d, 0.0) / a
    if k == 16:
        return np.tanh(v / (0.8 * b))
    if k == 18:
        return d * d / a
    if k == 19:
        return d / a - z
    if k == 20:
        return np.sign(v) * np.sqrt(abs(v) / b)
    return 0.0


@njit
def memory(k, d, v, z, a, b):
    """Rate of the inner state: Bouc-Wen, Maxwell."""
    if k == 12:
        return v / a * 2.5 * (1 - abs(z) * (0.6 * np.sign(v * z) + 0.4) * abs(z))
    if k == 19:
        return (d / a - z) * b / a * 0.6
    return 0.0


@njit
def rates(A, B, g, dv, vv, k, q, a, b, p, x, z, u, t):
    """Rates of the states and of the inner one, and the force."""
    d, v = dv @ x, vv @ x
    f = q * law(k, d, v, z, t, a, b, p)
    return A @ x + B @ u + g * f, memory(k, d, v, z, a, b), f, d, v


@njit
def march(A, B, Cs, Cr, Co, H, g, dv, vv, k, q, a, b, p, x, u, dt, n, foh, Kp, Kd, ref, loop):
    """Outputs, inputs and the motion at the site, n steps of Runge-Kutta a sample."""
    N = u.shape[1]
    y, uu, seen, z, before, h = np.empty((Cs.shape[0], N)), u.copy(), np.empty((2, N)), 0.0, 0.0, dt / n
    for s in range(N):
        w0 = uu[:, s].copy()
        if loop:
            e = ref[s] - Cs[0] @ x
            w0[0] = Kp * e + Kd * (e - before) / dt
            before = e
            uu[:, s] = w0
        r, _, f, d, v = rates(A, B, g, dv, vv, k, q, a, b, p, x, z, w0, s / N)
        y[:, s] = Cs @ x + Cr @ r + Co @ w0 + H * f
        seen[0, s], seen[1, s] = d, v
        w1 = uu[:, min(s + 1, N - 1)] if foh else w0
        for i in range(n):
            wa, wm = w0 + (w1 - w0) * (i / n), w0 + (w1 - w0) * ((i + 0.5) / n)
            wb, t = w0 + (w1 - w0) * ((i + 1) / n), (s + i / n) / N
            k1, z1, _, _, _ = rates(A, B, g, dv, vv, k, q, a, b, p, x, z, wa, t)
            k2, z2, _, _, _ = rates(A, B, g, dv, vv, k, q, a, b, p, x + h / 2 * k1, z + h / 2 * z1, wm, t)
            k3, z3, _, _, _ = rates(A, B, g, dv, vv, k, q, a, b, p, x + h / 2 * k2, z + h / 2 * z2, wm, t)
            k4, z4, _, _, _ = rates(A, B, g, dv, vv, k, q, a, b, p, x + h * k3, z + h * z3, wb, t)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            z = z + h / 6 * (z1 + 2 * z2 + 2 * z3 + z4)
        if not np.all(np.isfinite(x)) or np.abs(x).max() > 1e12:
            y[:, :] = np.nan
            break
    return y, uu, seen


class Plant:
    """x' = A x + B u + g f; y = Cs x + Cr x' + Co u + H f."""

    def __init__(self, A, B, Cs, names, sites, dt, amp, Cr=None, loop=None):
        self.A, self.B, self.Cs = (np.atleast_2d(np.array(m, float)) for m in (A, B, Cs))
        self.Cr = np.zeros_like(self.Cs) if Cr is None else np.atleast_2d(np.array(Cr, float))
        self.Co = np.zeros((len(self.Cs), self.B.shape[1]))
        self.states, self.inputs, self.outputs = names
        self.dt, self.loop, self.amp = dt, loop, np.atleast_1d(np.array(amp, float))
        self.sites = {k: tuple(np.array(w, float) for w in v) for k, v in sites.items()}

    @property
    def C(self):
        return self.Cs + self.Cr @ self.A

    @property
    def D(self):
        return self.Co + self.Cr @ self.B


def second(M, C, K, F, out, links, names, dt, amp):
    """M q'' + C q' + K q = F u; sensors ("d" | "v" | "a", row) or ("F", link): a load cell."""
    M, C, K = (np.array(m, float) for m in (M, C, K))
    n, Mi = len(M), np.linalg.inv(M)
    F, zero = np.array(F, float).reshape(n, -1), np.zeros(n)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-Mi @ K, -Mi @ C]])
    Cs, Cr = [], []
    for kind, w in out:
        vec, k, c = links[w] if kind == "F" else (w, 1.0 * (kind == "d"), 1.0 * (kind == "v"))
        vec = np.array(vec, float)
        Cs.append(np.r_[k * vec, c * vec])
        Cr.append(np.r_[zero, vec * (kind == "a")])
    sites = {}
    for name, (row, _, _) in links.items():
        vec = np.array(row, float)
        reads = [float(kind == "F" and w == name) for kind, w in out]
        sites[name] = (np.r_[vec, zero], np.r_[zero, vec], np.r_[zero, -Mi @ vec], reads)
    states = [*names[0], *("v" + q for q in names[0])]
    return Plant(A, np.vstack([np.zeros_like(F), Mi @ F]), Cs, (states, *names[1:]), sites, dt, amp, Cr)


def held(ks, cs, G):
    G = np.array(G, float)
    return G.T @ np.diag(cs) @ G, G.T @ np.diag(ks) @ G


def loadcell(m1=2.0, m2=1.4, m3=0.9, k1=900.0, k2=1500.0, k3=1100.0, c1=2.0, c2=1.5, c3=1.2):
    G = [[1, 0, 0], [-1, 1, 0], [0, -1, 1]]
    links = {"l1": (G[0], k1, c1), "l2": (G[1], k2, c2), "l3": (G[2], k3, c3)}
    C, K = held([k1, k2, k3], [c1, c2, c3], G)
    names = (["x1", "x2", "x3"], ["F"], ["cell", "pos3"])
    return second(
        np.diag([m1, m2, m3]), C, K, [0, 0, 1], [("F", "l2"), ("d", [0, 0, 1])], links, names, 0.02, 20
    )


def groundcell(m1=30.0, m2=18.0, k1=2.4e5, k2=1.1e5, c1=190.0, c2=130.0):
    G = [[1, 0], [-1, 1]]
    C, K = held([k1, k2], [c1, c2], G)
    links = {"l1": (G[0], k1, c1), "l2": (G[1], k2, c2)}
    names = (["q1", "q2"], ["hammer"], ["reaction", "acc2"])
    return second(np.diag([m1, m2]), C, K, [1, 0], [("F", "l1"), ("a", [0, 1])], links, names, 0.004, 300)


def accel2(m1=4.0, m2=3.0, k1=3000.0, k2=1800.0, c1=6.0, c2=4.0):
    G = [[1, 0], [-1, 1]]
    C, K = held([k1, k2], [c1, c2], G)
    links = {"l1": (G[0], k1, c1), "l2": (G[1], k2, c2)}
    names = (["x1", "x2"], ["shaker"], ["acc1", "acc2"])
    return second(np.diag([m1, m2]), C, K, [0, 1], [("a", [1, 0]), ("a", [0, 1])], links, names, 0.01, 15)


def shunt(R1=3.0, L1=0.01, C1=2e-4, R2=8.0, L2=0.02, Rc=2e-3):
    A = [[-R1 / L1, -1 / L1, 0], [1 / C1, 0, -1 / C1], [0, 1 / L2, -R2 / L2]]
    sites = {
        "R2": ([0, 0, 0], [0, 0, 1], [0, 0, -1 / L2], [1, 0]),
        "i1": ([0] * 3, [1, 0, 0], [-1 / L1, 0, 0], [0, 0]),
    }
    return Plant(
        A,
        [[1 / L1], [0], [0]],
        [[0, 0, R2], [0, 1, 0]],
        (["i1", "v", "i2"], ["U"], ["load", "cap"]),
        sites,
        4e-4,
        12,
    )


def maxwell(m=1.5, k=300.0, c=1.2, km=400.0, tau=0.08):
    A = [[0, 1, 0], [-k / m, -c / m, -1 / m], [0, km, -1 / tau]]
    sites = {"x": ([1, 0, 0], [0, 1, 0], [0, -1 / m, 0], [0])}
    return Plant(A, [[0], [1 / m], [0]], [[1, 0, 0]], (["x", "v", "Fm"], ["F"], ["pos"]), sites, 0.02, 5)


def thermal4(C1=80.0, C2=120.0, C3=60.0, C4=150.0, G12=2.0, G23=1.2, G34=1.6, G1=0.3, G4=0.5):
    A = np.diag([-(G12 + G1) / C1, -(G12 + G23) / C2, -(G23 + G34) / C3, -(G34 + G4) / C4])
    A[0, 1], A[1, 0], A[1, 2] = G12 / C1, G12 / C2, G23 / C2
    A[2, 1], A[2, 3], A[3, 2] = G23 / C3, G34 / C3, G34 / C4
    e = np.eye(4)
    sites = {
        "T1": (0 * e[0], e[0], -e[0] / C1, [0, 0]),
        "T4": (0 * e[0], e[3], -e[3] / C4, [0, 0]),
        "T2-T3": (0 * e[0], e[1] - e[2], -e[1] / C2 + e[2] / C3, [0, 0]),
    }
    names = (["T1", "T2", "T3", "T4"], ["heat"], ["Ta", "Td"])
    return Plant(A, [[1 / C1], [0], [0], [0]], e[[0, 3]], names, sites, 6.0, 15)


def tanks(A1=0.5, A2=0.3, a1=0.02, a2=0.015):
    sites = {"h2": ([0, 0], [0, 1], [0, -1 / A2], [0, 1]), "h1": ([0, 0], [1, 0], [-1 / A1, 1 / A2], [0, 0])}
    A = [[-a1 / A1, 0], [a1 / A2, -a2 / A2]]
    names = (["h1", "h2"], ["qin"], ["level2", "outflow"])
    return Plant(A, [[1 / A1], [0]], [[0, 1], [0, a2]], names, sites, 2.0, 0.02)


def gear(Jm=3e-4, Jl=0.02, N=7.0, k=9.0, c=0.01, bm=1.5e-3, bl=0.02):
    g = np.array([1 / N, -1.0])
    links = {"shaft": (g, k, c), "thm": ([1, 0], 0, bm), "thl": ([0, 1], 0, bl)}
    names = (["thm", "thl"], ["torque"], ["enc_m", "enc_l"])
    C = c * np.outer(g, g) + np.diag([bm, bl])
    out = [("d", [1, 0]), ("d", [0, 1])]
    return second(np.diag([Jm, Jl]), C, k * np.outer(g, g), [1, 0], out, links, names, 0.005, 0.05)


def rlc4(R1=4.0, L1=2e-3, C1=3e-5, L2=3e-3, C2=2e-5, RL=15.0):
    A = [
        [-R1 / L1, -1 / L1, 0, 0],
        [1 / C1, 0, -1 / C1, 0],
        [0, 1 / L2, 0, -1 / L2],
        [0, 0, 1 / C2, -1 / RL / C2],
    ]
    e, none = np.eye(4), np.zeros(4)
    sites = {
        "v2": (none, e[3], -e[3] / C2, [0, 0]),
        "i1": (none, e[0], -e[0] / L1, [0, 0]),
        "i2": (none, e[2], -e[2] / L2, [0, 0]),
    }
    names = (["i1", "v1", "i2", "v2"], ["vin"], ["vout", "iin"])
    return Plant(A, [[1 / L1], [0], [0], [0]], e[[3, 0]], names, sites, 1e-4, 10)


def pend(m=0.4, l=0.6, b=0.03, J=0.02, gr=9.81):
    inertia = m * l * l + J
    sites = {"th": ([1, 0], [0, 1], [0, -1 / inertia], [0])}
    A = [[0, 1], [-m * gr * l / inertia, -b / inertia]]
    return Plant(A, [[0], [1 / inertia]], [[1, 0]], (["th", "w"], ["tau"], ["angle"]), sites, 0.03, 0.3)


def servo(m=2.5, c=4.0, k=40.0):
    sites = {"x": ([1, 0], [0, 1], [0, -1 / m], [0])}
    A, names = [[0, 1], [-k / m, -c / m]], (["x", "v"], ["u"], ["y"])
    return Plant(A, [[0], [1 / m]], [[1, 0]], names, sites, 0.01, 0.1, loop=(400.0, 25.0))


def seat(mb=250.0, ms=60.0, kb=2e4, ks=9e3, cb=1500.0, cs=300.0):
    G = np.array([[1, 0], [-1, 1]])
    C, K = held([kb, ks], [cb, cs], G)
    links, names = (
        {"body": (G[0], kb, cb), "seat": (G[1], ks, cs)},
        (["zb", "zs"], ["road"], ["acc", "Fseat"]),
    )
    p = second(np.diag([mb, ms]), C, K, [0, 0], [("a", [0, 1]), ("F", "seat")], links, names, 0.01, 0.02)
    p.B = np.array([[0.0], [0.0], [kb / mb], [0.0]])
    del p.sites["body"]
    return p


def beamtip(m=0.3, EI=2.0, L=0.5):
    h = L / 2
    K = np.linalg.inv(1 / EI * np.array([[h**3 / 3, 5 * h**3 / 6], [5 * h**3 / 6, 8 * h**3 / 3]]))
    M, links = np.diag([m / 2, m / 4]), {"w2": ([0, 1], 0, 0), "w1": ([1, 0], 0, 0)}
    names = (["w1", "w2"], ["F"], ["tip", "acc"])
    return second(M, 1e-3 * K + 0.2 * M, K, [1, 0], [("d", [0, 1]), ("a", [1, 0])], links, names, 0.004, 1.5)


PLANTS = {
    f.__name__: f
    for f in (
        loadcell,
        groundcell,
        accel2,
        shunt,
        maxwell,
        thermal4,
        tanks,
        gear,
        rlc4,
        pend,
        servo,
        seat,
        beamtip,
    )
}
DRY = {"coulomb_friction", "smooth_friction", "stribeck_friction", "lugre_friction", "asymmetric_friction"}
#: Law: its number, and the kinds of the library that are the same law; none for most of those outside it.
LAWS = {
    "coulomb": (1, DRY),
    "cubic": (2, {"cubic_stiffness"}),
    "quadratic": (3, {"quadratic_damping", "power_damping"}),
    "clearance": (4, {"clearance", "soft_clearance"}),
    "stop": (5, {"end_stop"}),
    "stribeck": (6, {"stribeck_friction", "lugre_friction"}),
    "stiffness": (7, {"stiffness", "P"}),
    "damping": (8, {"damping", "P"}),
    "bilinear": (9, {"bilinear_stiffness", "end_stop"}),
    "sine": (10, {"cogging"}),
    "v1.5": (11, {"power_damping"}),
    "boucwen": (12, {"hysteresis"}),
    "kt": (13, set()),
    "cubdamp": (14, {"cubic_damping", "power_damping"}),
    "valve": (15, set()),
    "smooth": (16, {"smooth_friction"}),
    "quadspring": (18, {"quadratic_stiffness"}),
    "maxwell": (19, {"maxwell_element"}),
    "sqrtv": (20, {"power_damping", "sqrt_flow"}),
}
BY_POSITION = {
    "cubic",
    "clearance",
    "stop",
    "stiffness",
    "bilinear",
    "sine",
    "boucwen",
    "kt",
    "valve",
    "quadspring",
    "maxwell",
}
CHANNELS = {
    "saturation": {"input_saturation"},
    "deadzone": {"input_deadzone"},
    "delay": {"input_delay", "output_delay"},
    "lag": {"input_lag", "output_lag", "input_smoothing", "output_smoothing"},
    "power": {"input_power"},
    "ingain": {"input_gain", "P"},
    "clip": {"output_saturation", "output_range"},  # with an offset behind it the two limits differ
}


def excite(kind, N, dt, T, rng):
    """An input of size one for a plant of the time T."""
    t = np.arange(N) * dt
    if kind == "steps":
        length = max(int(T / dt * 1.5), 5)
        return np.repeat(rng.uniform(-1, 1, N // length + 2), length)[:N] * 1.5
    if kind == "prbs":
        length = max(int(T / dt / 5), 1)
        return np.repeat(rng.choice([-1.0, 1], N // length + 2), length)[:N]
    if kind == "multisine":
        period = N // 4
        X, top = np.zeros(period // 2 + 1, complex), max(min(int(period * dt * 3 / T), period // 3), 6)
        X[1:top] = np.exp(2j * np.pi * rng.random(top - 1))
        s = np.fft.irfft(X, period)
        return np.tile(s / s.std(), N // period + 1)[:N]
    if kind == "hammer":
        u, w = np.zeros(N), max(int(T / dt / 20), 2)
        for s in rng.integers(0, N - w, int(max(N * dt / T / 6, 3))):
            u[s : s + w] += rng.uniform(0.5, 1) * np.sin(np.pi * np.arange(w) / w) * 5
        return u
    if kind == "chirp":
        low, high = 0.1 / T, 3 / T
        return 1.3 * np.sin(2 * np.pi * (low * t + (high - low) * t**2 / 2 / t[-1]))
    a = np.exp(-dt / T * 6)
    e = lfilter([1], [1, -a], rng.standard_normal(N))
    return e / e.std()


def simulated(p, u, foh, site=None, k=0, q=0.0, a=1.0, b=1.0, size=1.0, x0=None):
    """Outputs, inputs and the motion at a site; in a loop u is the reference."""
    nothing = np.zeros(len(p.A))
    d, v, g, H = p.sites[site] if site else (nothing, nothing, nothing, np.zeros(len(p.Cs)))
    fastest = np.abs(np.linalg.eigvals(p.A)).max()
    n = int(max(12, min(80, np.ceil(p.dt * fastest / 0.15))))
    Kp, Kd = p.loop or (0.0, 0.0)
    start = nothing if x0 is None else np.asarray(x0, float)
    given, ref = (u, np.zeros(u.shape[1])) if p.loop is None else (0 * u, u[0])
    return march(
        p.A,
        p.B,
        p.Cs,
        p.Cr,
        p.Co,
        H,
        g,
        d,
        v,
        k,
        q,
        a,
        b,
        size,
        start,
        np.ascontiguousarray(given),
        p.dt,
        n,
        foh and p.loop is None,
        Kp,
        Kd,
        np.ascontiguousarray(ref),
        p.loop is not None,
    )


def sized(p, u, foh, clean, c, size):
    """Scale of a law by its share of the outputs, and the rms that it is written in."""
    number = LAWS[c["missing"]][0]
    _, _, seen = simulated(p, u, foh, site=c["site"])
    a, b = max(seen[0].std(), 1e-12), max(seen[1].std(), 1e-12)
    q = 1e-3 * np.linalg.norm(p.A, 2) * b / np.linalg.norm(p.sites[c["site"]][2])
    for _ in range(12):
        y = simulated(p, u, foh, c["site"], number, q, a, b, size)[0]
        loss = np.sqrt(np.mean(np.var(y - clean, axis=1) / np.var(clean, axis=1)))
        if not np.isfinite(loss):
            q /= 10
            continue
        if abs(np.log(max(loss, 1e-12) / c["loss"])) < 0.2:
            break
        q *= float(np.clip(c["loss"] / max(loss, 1e-12), 0.02, 100)) ** 0.9
    return {"site": c["site"], "k": number, "q": q, "a": a, "b": b, "size": size}


def drawn(seed):
    """What a seed hides, the nominal plant, and the rest of its generator."""
    rng, c = np.random.default_rng(700000 + seed), {"seed": seed}
    c["plant"] = list(PLANTS)[seed % len(PLANTS)]
    p = PLANTS[c["plant"]]()
    single = len(p.C) == 1 and p.B.shape[1] == 1 and not p.loop
    c["handed"] = str(
        rng.choice(["named"] * 5 + ["plain"] * 2 + ["sampled", "physical"] + ["tf"] * 2 * single)
    )
    c["samples"] = int(rng.choice([300, 450, 700, 1000], p=[0.3, 0.3, 0.25, 0.15]))
    c["input"] = str(rng.choice(["steps", "prbs", "multisine", "hammer", "chirp", "noise"]))
    c["records"] = min(int(rng.choice([1, 1, 1, 2, 3])), max(1, 1000 // c["samples"]))
    zoh = p.loop or c["handed"] == "sampled"
    c["hold"] = "zoh" if zoh else str(rng.choice(["zoh", "zoh", "foh"]))
    site = list(p.sites)[rng.integers(len(p.sites))]
    moves = p.sites[site][0].any()
    pool = [("none", "none")] * 4 + [("numbers", "one")] * 2 + [("numbers", "all")] * 2
    pool += [("input", k) for k in CHANNELS if not (p.loop and k in ("delay", "clip"))]
    pool += [("site", k) for k in LAWS if moves or k not in BY_POSITION] * (2 if moves else 3)
    c["type"], c["missing"] = pool[rng.integers(len(pool))]
    c["site"] = site if c["type"] == "site" else ""
    c["loss"], c["noise"] = float(rng.choice([0.06, 0.12, 0.2, 0.35])), float(rng.choice([0.003, 0.01, 0.03]))
    kinds = [
        "white",
        "white",
        "white",
        "ar",
        "quant",
        "outliers",
        "nan",
        "offset",
        "x0",
        "inputnoise",
        "signal",
    ]
    c["nuisance"] = str(rng.choice(kinds))
    return c, p, rng


def altered(c, p, rng):
    """The plant with numbers that are off; names the one."""
    make = PLANTS[c["plant"]]
    numbers = {n: q.default for n, q in inspect.signature(make).parameters.items() if n not in ("gr", "Rc")}
    if c["missing"] == "one":
        c["number"] = list(numbers)[rng.integers(len(numbers))]
        numbers[c["number"]] *= 1 + rng.uniform(0.08, 0.4) * rng.choice([-1, 1])
    else:
        numbers = {n: value * (1 + 0.08 * rng.standard_normal()) for n, value in numbers.items()}
    return make(**numbers)


def through_input(kind, u, s0):
    """What an actuator makes of its command."""
    if kind == "saturation":
        return np.clip(u, -1.1 * s0, 1.1 * s0)
    if kind == "deadzone":
        return np.sign(u) * np.maximum(abs(u) - 0.25 * s0, 0)
    if kind == "power":
        return np.sign(u) * abs(u / s0) ** 1.35 * s0
    return u * 1.2 if kind == "ingain" else u


def through_output(c, y, dt, T, rng):
    """What a sensor makes of the outputs."""
    if c["type"] != "input":
        return y
    if c["missing"] == "delay":
        n = int(rng.integers(1, 4))
        return np.c_[np.repeat(y[:, :1], n, 1), y[:, :-n]]
    if c["missing"] == "lag":
        a = np.exp(-dt / (T / 6))
        return lfilter([1 - a], [1, -a], y)
    if c["missing"] == "clip":
        limit = 1.3 * y[0].std()
        y[0] = np.clip(y[0], -limit, limit)
    return y


def recorded(c, y, u, rng):
    """Outputs and inputs as a logger keeps them."""
    sd, kind = np.maximum(y.std(1, keepdims=True), 1e-15), c["nuisance"]
    sig = c["noise"] * sd
    e = sig * rng.standard_normal(y.shape)
    if kind == "ar":
        e = lfilter([np.sqrt(1 - 0.85**2)], [1, -0.85], e)
    if kind == "signal":
        e = e * (0.3 + 2 * abs(y) / sd)
    if kind == "outliers":
        e = np.where(rng.random(y.shape) < 0.008, rng.standard_normal(y.shape) * sd * 0.8, e)
    y = y + e
    if kind == "quant":
        y = np.round(y / (3 * sig)) * 3 * sig
    if kind == "offset":
        y = y + 0.4 * sd
    if kind == "inputnoise":
        u = u + 0.02 * u.std(axis=1, keepdims=True) * rng.standard_normal(u.shape)
    if kind == "nan":  # missing samples, filled in by straight lines
        for row in y:
            gone, s = rng.random(len(row)) < 0.02, int(rng.integers(10, len(row) - 30))
            gone[s : s + 12] = True
            row[gone] = np.interp(np.flatnonzero(gone), np.flatnonzero(~gone), row[~gone])
    return y, u


def made(seed):
    """What is hidden, the truth as kinds, the nominal plant and the records; None where it runs away."""
    c, p, rng = drawn(seed)
    slow = np.abs(np.linalg.eigvals(p.A))
    slow = np.sort(slow[slow > 1e-6 * slow.max()])
    T, N, foh = 2 * np.pi / np.sqrt(slow[0] * slow[len(slow) // 2]), c["samples"], c["hold"] == "foh"
    scale = [1, 0.5, 2.0]
    commands = [
        np.array([excite(c["input"], N, p.dt, T, rng) * amp for amp in p.amp]) * scale[r]
        for r in range(c["records"])
    ]
    size = float(rng.uniform(0.6, 1.2))
    clean = [simulated(p, u, foh)[0] for u in commands]
    inputs, true, laws, truth, x0 = commands, p, {}, set(), None
    if c["type"] == "site":
        truth = LAWS[c["missing"]][1]
        laws = sized(p, commands[0], foh, clean[0], c, size)
    elif c["type"] == "numbers":
        truth, true = {"P"}, altered(c, p, rng)
    elif c["type"] == "input" and p.loop and c["missing"] != "ingain":
        c["type"] = c["missing"] = "none"
    elif c["type"] == "input":
        truth = CHANNELS[c["missing"]]
        if p.loop:
            true = PLANTS[c["plant"]]()
            true.B = 1.2 * true.B
        else:
            inputs = [through_input(c["missing"], u, p.amp[0]) for u in commands]
    if c["nuisance"] == "x0":
        states = Plant(p.A, p.B, np.eye(len(p.A)), (p.states, p.inputs, p.states), {}, p.dt, p.amp)
        spread = 0.0 if p.loop else simulated(states, commands[0], foh)[0].std(axis=1)
        x0 = rng.standard_normal(len(p.A)) * spread
    records, loss = [], 0.0
    for u, sent, rest in zip(commands, inputs, clean, strict=True):
        y, given, _ = simulated(true, sent, foh, x0=x0, **laws)
        y = through_output(c, y, p.dt, T, rng)
        if not np.all(np.isfinite(y)):
            return c, truth, p, None
        loss = max(loss, float(np.max(np.std(y - rest, axis=1) / np.std(rest, axis=1))))
        y, given = recorded(c, y, given if p.loop else u, rng)
        labels = (
            {}
            if c["handed"] in ("plain", "tf") and not p.loop
            else {"input_labels": p.inputs, "output_labels": p.outputs}
        )
        if p.loop:
            c["handed"] = "named" if c["handed"] == "plain" else c["handed"]
            labels["input_labels"], given = ["u", "r"], np.r_[given, u[:1]]
        records.append(rco.Measurement(given, y, dt=p.dt, hold=c["hold"], **labels))
    if c["type"] in ("site", "input") and loss < 1e-6:  # the motion never reached it
        c["type"], truth = "none", set()
    return c, truth, p, records


def handed(p, how):
    """The nominal model as a user brings it."""
    names = {} if how == "plain" else {"inputs": p.inputs, "outputs": p.outputs, "states": p.states}
    system = ct.ss(p.A, p.B, p.C, p.D, **names)
    if how == "sampled":
        return ct.sample_system(system, p.dt, method="zoh")
    if how == "tf":
        return ct.ss2tf(system)
    return rco.physical(system) if how == "physical" else system


def controller(p):
    """Proportional and differential, sampled."""
    Kp, Kd = p.loop
    rate = Kd / p.dt
    return ct.ss(
        [[0.0]], [[1.0, -1.0]], [[-rate]], [[Kp + rate, -Kp - rate]], p.dt, inputs=["r", "y"], outputs=["u"]
    )
