"""Pictures and numbers of why_it_works.md: python docs/figures.py"""

import warnings
from contextlib import suppress
from pathlib import Path

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import rcorefine as rco

PICTURES = Path(__file__).resolve().parent / "pictures"
INITIAL, TRUE, REFINED, PAPER, OTHER = "tab:orange", "0.65", "tab:blue", "tab:green", "tab:red"
plt.rcParams.update({"axes.grid": True, "grid.alpha": 0.3, "legend.framealpha": 0.9, "font.size": 9})


def ss(A, B, C, dt=0):
    return ct.ss(A, np.reshape(np.array(B, dtype=float), (len(A), -1)), np.atleast_2d(C), 0, dt=dt)


def record(true, dt, w, seed, noise=0.02):
    """Outputs of the true system from rest, the input held, white sensor noise."""
    discrete = true if true.dt else true.sample(dt)
    y = ct.forced_response(discrete, dt * np.arange(w.size), w).outputs
    return rco.Measurement(w, noisy(y, seed, noise), dt=dt)


def noisy(y, seed, noise=0.02):
    return y + noise * y.std() * np.random.default_rng(1000 + seed).standard_normal(y.size)


def steps(n_samples, seed, every=20):
    return np.repeat(np.random.default_rng(seed).uniform(-1, 1, n_samples // every), every)


def response(model, omega):
    return ct.frequency_response(model, omega).frdata[0, 0]


def bode_error(model, true, dt, omega=None):
    """||G^ - G|| / ||G|| on 200 frequencies up to half the sampling frequency."""
    omega = np.geomspace(1e-2, 1, 200) * np.pi / dt if omega is None else omega
    size = response(true, omega)
    return float(np.linalg.norm(response(model, omega) - size) / np.linalg.norm(size))


def refined(refiner):
    """`refiner.system`; where the paper's discrete model has no exact continuous one, the nearest."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rco.ConversionWarning)
        return refiner.system


def fit(model, data):
    return float(rco.compare(model, data).fit[0])


def save(fig, name):
    fig.savefig(PICTURES / f"{name}.png", dpi=90)
    plt.close(fig)


# -- 1. the two stages ---------------------------------------------------------------------------------


def stages():
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    titles = "Stage 1: a dynamic correction", "Stage 2: a constant correction, absorbed"
    corrections = "$G_\\Delta(\\mathbf{q})$\nadapted", "$\\theta$\nconstants"
    senses = "$x,\\ w$", "$x$ of stage 1,\n$w$"
    results = "estimates the states $x$", "gives the refined model"
    for ax, title, correction, sensed, result in zip(axes, titles, corrections, senses, results, strict=True):
        ax.set(xlim=(0, 10), ylim=(0, 8), title=title)
        ax.axis("off")
        box(ax, 1.9, 5.9, 2.2, "true system", TRUE)
        box(ax, 1.9, 2.9, 2.2, "initial model", INITIAL)
        box(ax, 2.2, 0.6, 1.6, correction, REFINED)
        arrow(ax, (0.2, 6.6), (1.9, 6.6), "$w$")
        arrow(ax, (0.9, 6.6), (0.9, 3.9), (0.9, 3.9), (1.9, 3.9))
        arrow(ax, (4.1, 6.6), (6.9, 6.6), (6.9, 6.6), (6.9, 5.4))
        arrow(ax, (4.1, 3.9), (6.9, 3.9), (6.9, 3.9), (6.9, 4.6))
        ax.text(5.4, 6.75, "$y$ measured")
        ax.text(4.3, 4.05, "$\\hat y$ simulated")
        ax.text(6.9, 5.0, r"$\Sigma$", ha="center", va="center", bbox={"boxstyle": "circle", "fc": "white"})
        ax.text(7.1, 5.6, "$-$")
        ax.text(7.1, 4.2, "+")
        arrow(ax, (7.2, 5.0), (9.0, 5.0))
        ax.text(8.0, 5.15, "$z$")
        arrow(ax, (4.1, 3.2), (4.7, 3.2), (4.7, 3.2), (4.7, 1.3), (4.7, 1.3), (3.8, 1.3))
        ax.text(4.8, 2.2, sensed, va="center")
        arrow(ax, (2.2, 1.3), (1.2, 1.3), (1.2, 1.3), (1.2, 3.2), (1.2, 3.2), (1.9, 3.2))
        ax.text(0.75, 2.2, "$u$")
        arrow(ax, (9.0, 5.0), (9.0, 0.9), (9.0, 0.9), (3.8, 0.9), dashed=True)
        ax.text(5.2, 0.35, f"adapts to make $z$ small;\n{result}", va="top", fontsize=8)
    save(fig, "stages")
    example = rco.examples.one_dof(form="observable")
    data = example.record(6000, rng=1)
    for used in (True, False):
        refiner = rco.RCORefiner.paper(
            example.initial, dt=example.dt, history=True, use_estimated_states=used, **example.settings
        ).run(data)
        first, second = refiner.history.performance(4500)
        what = "with stage 1" if used else "without stage 1"
        print(f"1-DOF, {what:16s} stage 1 {first[0]:.1e}, stage 2 {second[0]:.1e} of rms(y)")


def box(ax, x, y, width, text, color):
    ax.add_patch(plt.Rectangle((x, y), width, 1.4, fc=color, alpha=0.35, ec="0.3"))
    ax.text(x + width / 2, y + 0.7, text, ha="center", va="center")


def arrow(ax, *points, dashed=False):
    """Line through pairs of points, a head on the last; a text as last point names it."""
    text = points[-1] if isinstance(points[-1], str) else ""
    points = points[:-1] if text else points
    style = {"color": "0.3", "linestyle": "--" if dashed else "-"}
    for start, end in zip(points[:-2:2], points[1:-2:2], strict=True):
        ax.plot(*np.transpose([start, end]), lw=1, **style)
    ax.annotate("", points[-1], points[-2], arrowprops={"arrowstyle": "->", **style})
    if text:
        ax.text(points[0][0] + 0.1, points[0][1] + 0.15, text)


# -- 2. zeros and Markov parameters ----------------------------------------------------------------------


def zeros():
    def plant(radius, angle, zero):
        return ss([[0, 1], [-(radius**2), 2 * radius * np.cos(angle)]], [0, 1], [-zero, 1], dt=1)

    counts = (1, 2, 5, 10, 20, 40, 80)
    places = {-0.5: REFINED, -0.99: PAPER, -1.05: OTHER}
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True, layout="constrained")
    for ax, radius, title in zip(axes, (0.9, 0.98), ("well damped", "lightly damped"), strict=True):
        worst = 0.0
        for zero, color in places.items():
            true, start = plant(radius - 0.1 if radius < 0.95 else 0.97, 0.3, zero), plant(radius, 0.4, zero)
            found, first = np.full((2, len(counts), 3), np.inf)
            for seed in range(3):
                data = record(true, 1, np.random.default_rng(seed).standard_normal(3000), seed)
                for row, markov in enumerate(counts):
                    setting = {"markov": markov, "window": 200, "learning_rate": 1e4}
                    with suppress(rco.DivergenceError):  # found stays infinite
                        refiner = rco.RCORefiner.paper(start, dt=1, history=True, **setting).run(data)
                        found[row, seed] = bode_error(refined(refiner), true, 1)
                        first[row, seed] = refiner.history.performance(2000)[0][0]
                worst = max(worst, bode_error(rco.RCORefiner(start, dt=1).run(data).system, true, 1))
            middle = np.median(found, axis=1)
            ax.loglog(counts, middle, "o-", color=color, label=f"zero at {zero:g}")
            gone = np.isinf(middle)
            ax.plot(np.array(counts)[gone], np.full(gone.sum(), 4.0), "x", color=color, ms=8)
            initial = bode_error(start, true, 1)
            shown = ", ".join("diverged" if np.isinf(m) else f"{m:.3f}" for m in middle)
            print(f"{title}, zero {zero:5.2f}: initial {initial:.2f}; mu {counts}: {shown}")
            print("    stage 1, z over y: " + ", ".join(f"{z:.2f}" for z in np.median(first, axis=1)))
        ax.axhline(worst, color="black", ls="--", label="default, its worst run")
        ax.set(xlabel="Markov parameters $\\mu$", title=title, xticks=counts, xticklabels=counts)
        ax.minorticks_off()
        print(f"{title}: default, worst of 9 runs {worst:.4f}")
    axes[0].set(ylabel="Bode error of the refined model", ylim=(3e-4, 6))
    axes[0].legend(loc="center right", bbox_to_anchor=(1.0, 0.62))
    axes[1].text(1.15, 3.5, "diverged")
    save(fig, "zeros")
    for name, plant in {
        "mass, force to position": mass(1, 0.5, 20),
        "two masses": two_masses(1, 0.05, 20),
    }.items():
        print(f"{name}: zeros {len(plant.zeros())} in continuous time, "
              f"sampled at 0.05 s {np.round(np.sort(plant.sample(0.05).zeros().real), 3)}")  # fmt: skip


# -- 3. window and learning rate -------------------------------------------------------------------------


def windows():
    example = rco.examples.rlc()
    data = example.record(6000, noise=0.02, rng=1)
    lengths = np.array([50, 100, 200, 400, 800, 1600])
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.3), layout="constrained")
    for rate, color in ((1.0, PAPER), (1e4, REFINED), (1e5, OTHER)):
        scatter = []
        for window in lengths:
            setting = {"order": 5, "markov": 1, "learning_rate": 100.0, "window": int(window)}
            refiner = rco.RCORefiner.paper(
                example.initial, dt=example.dt, static_learning_rate=rate, history=True, **setting
            ).run(data)
            course = refiner.history.theta2[0, 1]  # acts on the current
            late = course[3000:]
            scatter.append(100 * late.std() / abs(late.mean()))
            if window in (100, 1600):
                name = f"$\\alpha$ = {rate:g}, p = {window}"
                axes[1].plot(course / np.median(course[-1000:]), color=color, lw=1,
                             ls="-" if window == 100 else ":", label=name)  # fmt: skip
        axes[0].loglog(lengths, scatter, "o-", color=color, label=f"$\\alpha$ = {rate:g}")
        print(
            f"RLC, alpha {rate:g}: scatter in % at p {lengths.tolist()}: "
            + ", ".join(f"{s:.2f}" for s in scatter)
        )
    axes[0].loglog(lengths, 0.53 * np.sqrt(50 / lengths), color="0.6", lw=4, alpha=0.5, label="$1/\\sqrt{p}$")
    axes[0].set(xlabel="window p [samples]", ylabel="scatter of the coefficient [%]", xticks=lengths)
    axes[0].set(xticklabels=lengths, title="scatter over the last 3000 samples")
    axes[0].minorticks_off()
    axes[0].legend()
    axes[1].set(xlabel="sample", ylabel="coefficient / its last median", ylim=(-0.2, 1.4))
    axes[1].set(title="the coefficient of the current")
    axes[1].legend(fontsize=7)
    save(fig, "window")


# -- 4. matched and unmatched ----------------------------------------------------------------------------


def matching():
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.3), sharey=True, layout="constrained")
    cases = {"RLC circuit (matched)": rco.examples.rlc(), "1-DOF (unmatched)": rco.examples.one_dof()}
    for ax, (title, example) in zip(axes, cases.items(), strict=True):
        data = example.record(6000, noise=0.02, rng=1)
        paper = refined(rco.RCORefiner.paper(example.initial, dt=example.dt, **example.settings).run(data))
        default = rco.RCORefiner(example.initial, dt=example.dt).run(data)
        models = {"initial": (example.initial, INITIAL), "paper's correction through B": (paper, PAPER),
                  "default": (default.system, REFINED)}  # fmt: skip
        omega = np.geomspace(1e-2, 1, 200) * np.pi / example.dt
        for name, (model, color) in models.items():
            error = np.abs(response(model, omega) / response(example.true, omega) - 1)
            ax.loglog(omega, error, color=color, label=name)
            print(f"{title}, {name}: Bode error {bode_error(model, example.true, example.dt):.4f}")
        print(f"{title}: form {default.form!r}, fits {rounded(default.scores)}")
        ax.set(title=title, xlabel="frequency [rad/s]")
    axes[0].set(ylabel="$|\\hat G - G|\\ /\\ |G|$", ylim=(1e-5, 1e3))
    axes[0].legend(loc="upper right")
    save(fig, "matched")


def rounded(scores):
    return {name: round(score, 1) for name, score in scores.items()}


# -- 5. the race -----------------------------------------------------------------------------------------


def mass(m, c, k):
    return ss([[0, 1], [-k / m, -c / m]], [0, 1 / m], [1, 0])


def race():
    true, start, dt, lag = mass(1.0, 0.5, 20.0), mass(1.2, 0.3, 28.0), 0.05, 0.15
    A = np.block([[true.A, np.zeros((2, 1))], [true.C / lag, -np.eye(1) / lag]])
    plants = {
        "parameters wrong": true,
        "structure wrong: a slow sensor": ss(A, [*true.B[:, 0], 0], [0, 0, 1]),
    }
    ends = (64, 128, 256, 512, 1024, 2048, 4096, 8192)
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.3), sharey=True, layout="constrained")
    colors = {"nonzero": REFINED, "discrete": OTHER, "initial": INITIAL}
    for ax, (title, plant) in zip(axes, plants.items(), strict=True):
        data = record(plant, dt, steps(10000, 3), 3)
        refiner, scores = rco.RCORefiner(start, dt=dt), []
        for end in ends:
            part = slice(refiner.n_samples, end)
            refiner.update(data.inputs[:, part], data.outputs[:, part])
            scores.append(refiner.scores)
        for form, color in colors.items():
            ax.semilogx(ends, [s.get(form, np.nan) for s in scores], "o-", color=color, label=form)
        ax.set(title=title, xlabel="samples", xticks=ends, xticklabels=ends, ylim=(-25, 105))
        ax.minorticks_off()
        unseen = data.segment(8192 * dt)
        print(f"{title}: taken {refiner.form!r}, fits {rounded(scores[-1])}, on unseen data "
              f"{fit(refiner.system, unseen):.1f} %, initial {fit(start, unseen):.1f} %")  # fmt: skip
    axes[0].set_ylabel("fit of the free run ahead [%]")
    axes[0].legend(loc="lower left")
    save(fig, "race")


# -- 6. when it does not work ------------------------------------------------------------------------------


def limits():
    true, start, dt, n = mass(1.0, 0.5, 20.0), mass(1.2, 0.3, 28.0), 0.05, 6000
    t = dt * np.arange(n)
    slow = sum(np.sin(rate * t) for rate in (0.05, 0.11, 0.17, 0.23))
    absorber = ss(
        [[0, 1, 0, 0], [-26, -0.6, 6, 0.1], [0, 0, 0, 1], [20, 1 / 3, -20, -1 / 3]],
        [0, 1, 0, 0],
        [1, 0, 0, 0],
    )
    coarse = 0.25
    w = np.random.default_rng(4).standard_normal(n)
    linear = ct.forced_response(true, coarse * np.arange(n), w).outputs  # python-control: linear between
    cases = {
        "not excited: slow input": (true, record(true, dt, slow, 1), {}, dt),
        "missing order: a second mass": (absorber, record(absorber, dt, steps(n, 2), 2), {}, dt),
        "wrong hold: held, was linear": (true, rco.Measurement(w, noisy(linear, 4), dt=coarse), {}, coarse),
        "the right hold": (
            true, rco.Measurement(w, noisy(linear, 4), dt=coarse, hold="foh"), {"hold": "foh"}, coarse,
        ),
        "closed loop, no reference": (true, closed_loop(true, dt, np.zeros(n)), {}, dt),
        "closed loop, reference moves": (true, closed_loop(true, dt, steps(n, 5)), {}, dt),
    }  # fmt: skip
    fig, axes = plt.subplots(2, 2, figsize=(9, 5.6), layout="constrained")
    drawn = iter(axes.flat)
    axis = None
    for title, (plant, data, setting, step) in cases.items():
        refiner = rco.RCORefiner(start, dt=step, **setting).run(data)
        model, omega = refined(refiner), np.geomspace(0.1, min(0.99 * np.pi / step, 40), 300)
        again = title in ("the right hold", "closed loop, reference moves")
        axis = axis if again else next(drawn)
        if not again:
            axis.loglog(omega, np.abs(response(plant, omega)), color=TRUE, lw=5, label="true")
            axis.loglog(omega, np.abs(response(start, omega)), color=INITIAL, label="initial")
            axis.set_title(title)
        axis.loglog(omega, np.abs(response(model, omega)), color=PAPER if again else REFINED,
                    ls="--" if again else "-", label=title if again else "refined")  # fmt: skip
        if title.startswith("not excited"):
            band(axis, refiner, omega)
        axis.legend(fontsize=7, loc="lower left")
        error = [bode_error(one, plant, step, omega) for one in (start, model)]
        print(f"{title}: form {refiner.form!r}, Bode error {error[0]:.3f} -> {error[1]:.3f}")
        print(f"    fit {fit(start, data):.1f} -> {fit(model, data):.1f} %, ahead {rounded(refiner.scores)}")
        for row in refiner.parameters:
            print(f"    {row.name} initial {row.initial:.3g}, value {row.value:.3g}, std {row.std:.2g}")
        print("    " + " ".join(str(refiner).split("std is the")[-1].split(". ", 1)[1].split()))
    axes[1, 0].set_xlabel("frequency [rad/s]")
    axes[1, 1].set_xlabel("frequency [rad/s]")
    for ax in axes[:, 0]:
        ax.set_ylabel("magnitude")
    save(fig, "limits")


def band(axis, refiner, omega):
    """95 % of the responses that the covariance of k/m, c/m and 1/m allows."""
    middle = [row.value for row in refiner.parameters]
    draws = np.random.default_rng(0).multivariate_normal(middle, refiner.covariance, 300)
    sizes = [np.abs(response(ss([[0, 1], [a, b]], [0, gain], [1, 0]), omega)) for a, b, gain in draws]
    axis.fill_between(
        omega, *np.percentile(sizes, [2.5, 97.5], axis=0), color=REFINED, alpha=0.25, label="95 %"
    )


def closed_loop(plant, dt, reference, gain=3.0):
    """Proportional control on the noisy output, an unmeasured white force besides."""
    discrete, rng = plant.sample(dt), np.random.default_rng(7)
    x, w, y = np.zeros((2, 1)), np.zeros(reference.size), np.zeros(reference.size)
    for k in range(reference.size):
        y[k] = (discrete.C @ x)[0, 0] + 0.001 * rng.standard_normal()
        w[k] = reference[k] - gain * y[k]
        x = discrete.A @ x + discrete.B * (w[k] + 0.1 * rng.standard_normal())
    return rco.Measurement(w, y, dt=dt)


def two_masses(m, c, k):
    """Force on the first, position of the second mass, between walls."""
    stiff = np.array([[2.0, -1.0], [-1.0, 2.0]]) / m
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-k * stiff, -c * stiff]])
    return ss(A, [0, 0, 1 / m, 0], [0, 1, 0, 0])


def stopped():
    """Stage 1 gives up, the refined model does not mind: what str() says."""
    true, start, dt = two_masses(1.0, 0.05, 20.0), two_masses(1.2, 0.03, 26.0), 0.05
    data = record(true, dt, steps(4000, 1), 1)
    refiner = rco.RCORefiner(start, dt=dt).run(data)
    print(refiner)
    print(f"zeros of the initial model {np.round(np.sort(start.sample(dt).zeros().real), 3)}")
    print(f"Bode error {bode_error(start, true, dt):.2f} -> {bode_error(refiner.system, true, dt):.4f}")
    try:
        rco.RCORefiner.paper(start, dt=dt, window=100, markov=1, learning_rate=100.0).run(data)
    except rco.DivergenceError as error:
        print(f"DivergenceError: {error}")


if __name__ == "__main__":
    PICTURES.mkdir(exist_ok=True)
    for draw in (stages, zeros, windows, matching, race, limits, stopped):
        print(f"\n== {draw.__name__}")
        draw()
