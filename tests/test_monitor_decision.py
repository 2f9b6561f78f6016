"""The decisions of a monitor: statistics and fits by block in, alarms out.

A stream is a course of its largest statistic over the threshold, 2 where a change begins. A look ranks
candidates by gains of log-likelihood; a follow-up fits the named effect to the last eight periods. A period
has forty samples, a block eight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import softmax

import rcorefine as rco
from rcorefine.inference.levels import Levels
from rcorefine.streaming import monitor, naming, score
from rcorefine.streaming.naming import Change, Fitted, MonitorRow

PERIOD, BLOCK, DT = 40, 8, 0.5
LEARN, CROSSED = 200, 239  # the threshold is crossed in the block that ends with this sample
LEVEL = Levels()
#: Candidates: two laws at one place, and one law at another place.
A, B, C = (
    rco.Effect(kind, place)
    for kind, place in (("stiffness", "link1"), ("clearance", "link1"), ("damping", "link2"))
)
NAMES = {A: "A", B: "B", C: "C"}
MODEL = rco.mass_spring_damper([1.0, 1.0], [0.4, 0.4], [100.0, 100.0])
UNITS = SimpleNamespace(unit=lambda effect, name: "")


class Look(NamedTuple):
    """What the fits to the samples since the change say."""

    gains: tuple[float, float, float] = (50.0, 0.0, 0.0)  # of A, B and C
    misfit: float = 1.0
    none: float = -np.inf
    sizes: tuple[int, int, int] = (1, 1, 1)  # coefficients


class Follow(NamedTuple):
    """What the named effect has become: of 100 samples, whose noise leaves a sum of squares of 100."""

    value: float = -10.0
    std: float = 1.0
    with_effect: float = 100.0
    without: float = 1000.0


class Course(NamedTuple):
    state: str  # "healthy", "waiting", or the name of the alarm
    rung: int | None  # sample at which it was raised
    ended: int  # alarms that have ended
    restarts: int
    looked: list[int]
    followed: list[int]
    monitor: Any


class State(NamedTuple):
    """A state without samples."""

    blocks: int = 0
    N: Any = None
    V: Any = None
    shared: Any = None
    sums: Any = None
    S: Any = None


def watched(
    samples: int,
    looks: Sequence[Look] = (Look(),),
    follows: Sequence[Follow] = (Follow(),),
    *,
    crossings: Sequence[int] = (CROSSED,),
    at_once: bool = True,
) -> Course:
    """Watch so many samples; the last look and follow-up repeat."""
    left, fits = list(looks), list(follows)
    looked, followed, restarts = list[int](), list[int](), list[int]()
    fake: Any = SimpleNamespace(
        block=BLOCK, period=PERIOD, false_alarms=0.01, candidates=(A, B, C),
        base=SimpleNamespace(dt=DT, structure=SimpleNamespace(model=UNITS)),
    )  # fmt: skip

    def advance(of: Any, state: State, block: Any, healthy: bool) -> tuple[State, float]:
        last = (state.blocks + 1) * BLOCK - 1
        return state._replace(blocks=state.blocks + 1), 2.0 if last in crossings else 0.5

    def begin_change(of: Any, state: State) -> Change:
        n = state.blocks * BLOCK
        return Change(n - 1, 9.0, 6.0, n + naming.next_look(0, PERIOD, 10**6), n + 4 * PERIOD, n - 1)

    def name(of: Any, state: State, change: Change) -> Change:
        look = left.pop(0) if len(left) > 1 else left[0]
        looked.append(state.blocks * BLOCK)
        rows = []
        for effect, gain, size in zip((A, B, C), look.gains, look.sizes, strict=True):
            names = [f"c{i}" for i in range(size)]
            values, std = dict.fromkeys(names, -10.0), dict.fromkeys(names, 1.0)
            rows.append(MonitorRow(effect, values, std, np.nan, gain, True))
        p = naming.shares(naming.change_of(change, np.full(3, -18.0)), np.array(look.gains), look.none)
        return replace(change, rows=naming.ranked(rows, p[1:]), misfit=look.misfit, none=look.none)

    def fit(self: Any, effect: Any, start: int, evaluations: int = 0) -> Any:
        if effect is None:
            return SimpleNamespace(cost=one().without, points=100, last=np.zeros(1))
        followed.append(start + 8 * PERIOD)
        found = one()
        return SimpleNamespace(
            theta=np.array([found.value]), std=np.array([found.std]), cost=found.with_effect
        )

    def one() -> Follow:
        return fits[min(len(followed), len(fits)) - 1]

    def restarted(state: State, x: Any) -> State:
        restarts.append(state.blocks * BLOCK)
        return state

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(monitor, "learn", lambda *_: fake)
        patched.setattr(monitor, "begin", lambda of: State(0, *[np.ones(1)] * 5))
        for module, what in (
            (monitor, advance),
            (monitor, begin_change),
            (naming, name),
            (naming, restarted),
        ):
            patched.setattr(module, what.__name__, what)
        patched.setattr(monitor, "found_anew", lambda of, state: state)
        patched.setattr(monitor, "adequacy_of", lambda *_: None)
        patched.setattr(monitor, "history_row", lambda *_: np.zeros(7))
        patched.setattr(naming.Fits, "fit", fit)
        watch = rco.Monitor(MODEL, [A, B, C], dt=DT, learn=LEARN)
        for part in [samples] if at_once else [1] * samples:
            watch.update(np.zeros(part), np.zeros((watch._base.structure.n_outputs, part)))
        change = watch._memory.change
    state, rang = "healthy" if change is None else "waiting", None
    if watch.alarm is not None:
        state, rang = NAMES[watch.alarm.effect], watch.alarm.sample
    return Course(state, rang, len(watch.past_alarms), len(restarts), looked, followed, watch)


TIE = Look((50.0, 0.0, 50.0))
#: Gain by which a place must lead: log of 99 to 1.
CLEAR = float(np.log(LEVEL.alarm_place / (1 - LEVEL.alarm_place)))
RIVAL = 0.5 * LEVEL.rival
#: Looks come with the block that ends 1/4, 1/2, 3/4, 1, 3/2, 2, 3 and 4 periods after the crossing.
LOOKS = [CROSSED + 1 + n for n in (16, 24, 32, 40, 64, 80, 120, 160)]
FIRST, SECOND, THIRD, LAST = LOOKS[0], LOOKS[1], LOOKS[2], LOOKS[-1]
ON_C = Look((0.0, 0.0, 50.0))


@pytest.mark.parametrize(
    ("samples", "options", "state", "rung"),
    [
        pytest.param(500, {"crossings": []}, "healthy", None, id="nothing crosses"),
        pytest.param(500, {"crossings": [LEARN - 1]}, "healthy", None, id="in the learning phase"),
        pytest.param(CROSSED, {}, "healthy", None, id="before the crossing"),
        pytest.param(CROSSED + 1, {}, "waiting", None, id="crossed, not named"),
        pytest.param(FIRST, {}, "waiting", None, id="one look is not enough"),
        pytest.param(SECOND - 1, {}, "waiting", None, id="before the second"),
        pytest.param(SECOND, {}, "A", SECOND - 1, id="clear twice in a row"),
        pytest.param(LAST + 1, {}, "A", SECOND - 1, id="the alarm keeps its time"),
        pytest.param(
            SECOND, {"looks": [Look((50.0, 0.0, 50.1)), Look()]}, "waiting", None, id="another led before"
        ),
        pytest.param(SECOND, {"looks": [TIE, Look()]}, "waiting", None, id="unclear, then clear"),
        pytest.param(THIRD, {"looks": [TIE, Look()]}, "A", THIRD - 1, id="unclear, then clear twice"),
        pytest.param(THIRD, {"looks": [ON_C, Look()]}, "A", THIRD - 1, id="the second place twice in a row"),
        pytest.param(THIRD, {"looks": [Look(), ON_C, Look()]}, "waiting", None, id="places that take turns"),
        pytest.param(
            SECOND, {"looks": [Look((50.0, 50.0, 0.0))]}, "A", SECOND - 1, id="two laws of one place"
        ),
        pytest.param(
            SECOND, {"looks": [Look((50.0, 0.0, 50 - CLEAR - 0.1))]}, "A", SECOND - 1, id="a place of .991"
        ),
        pytest.param(
            SECOND, {"looks": [Look((50.0, 0.0, 50 - CLEAR + 0.1))]}, "waiting", None, id="a place of .989"
        ),
        pytest.param(SECOND, {"looks": [Look(misfit=1.49)]}, "A", SECOND - 1, id="a name that leaves 1.49"),
        pytest.param(SECOND, {"looks": [Look(misfit=1.51)]}, "waiting", None, id="a name that leaves 1.51"),
        pytest.param(LAST - 1, {"looks": [TIE]}, "waiting", None, id="unclear for four periods"),
        pytest.param(LAST, {"looks": [TIE]}, "A", LAST - 1, id="patience is at its end"),
        pytest.param(LAST, {"looks": [Look(misfit=9.0)]}, "A", LAST - 1, id="at its end with a bad fit"),
        # laws that explain it as well
        pytest.param(
            SECOND, {"looks": [Look((50 - RIVAL + 0.1, 50.0, 0.0), sizes=(1, 2, 1))]}, "A", SECOND - 1,
            id="the simpler one",
        ),
        pytest.param(
            SECOND, {"looks": [Look((50 - RIVAL - 0.1, 50.0, 0.0), sizes=(1, 2, 1))]}, "B", SECOND - 1,
            id="100 times as likely",
        ),
        pytest.param(
            SECOND, {"looks": [Look((50.0, 49.0, 0.0), sizes=(2, 2, 1))]}, "A", SECOND - 1,
            id="of as many the likelier",
        ),
        pytest.param(
            LAST, {"looks": [Look((0.0, 50.0, 49.9), sizes=(1, 2, 1))]}, "B", LAST - 1,
            id="not one of another place",
        ),
        # a later look
        pytest.param(LAST, {"looks": [Look()] * 3 + [ON_C]}, "C", SECOND - 1, id="a later look"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("at_once", [True, False])
def test_an_alarm_waits_for_a_clear_name(
    samples: int, options: dict[str, Any], state: str, rung: int | None, at_once: bool
) -> None:
    found = watched(samples, at_once=at_once, **options)
    assert (found.state, found.rung) == (state, rung)
    assert found.ended == 0
    alarm = found.monitor.alarm
    if alarm is not None:
        assert (alarm.since_sample, alarm.crossed) == (CROSSED, CROSSED * DT)
        assert (alarm.time, alarm.ended) == (rung * DT, None)  # type: ignore[operator]


@pytest.mark.parametrize(
    ("misfit", "gain", "renamed"),
    [
        pytest.param(1.0, 50.0, True, id="as good"),
        pytest.param(1.79, 50.0, True, id="nearly as good"),
        pytest.param(1.81, 50.0, False, id="a worse fit"),
        pytest.param(1.0, 12.1, True, id="a gain of 12.1"),
        pytest.param(1.0, 11.9, False, id="a gain of 11.9"),
    ],
)
def test_a_later_look_keeps_the_name_that_fitted_well(misfit: float, gain: float, renamed: bool) -> None:
    assert naming.renames(misfit, 1.2, gain) == renamed


def test_looks_grow_rarer_and_follow_ups_come_every_four_periods() -> None:
    found = watched(CROSSED + 1 + 40 * PERIOD)
    assert found.looked == [FIRST, SECOND, *(CROSSED + 1 + n for n in (48, 96, 192, 384, 768, 1536))]
    assert watched(LAST + 1, [TIE]).looked == LOOKS
    # eight periods after the change, the last eight periods hold nothing else
    assert found.followed == [CROSSED + 1 + n * PERIOD for n in range(8, 41, 4)]


HEALED = CROSSED + 1 + 8 * PERIOD
GONE = Follow(0.0, 1.0, 100.0, 101.0)


@pytest.mark.parametrize(
    ("samples", "follow", "healed"),
    [
        pytest.param(HEALED, GONE, True, id="gone"),
        pytest.param(HEALED - 1, GONE, False, id="before eight periods"),
        pytest.param(HEALED, Follow(), False, id="as before"),
        # near zero: within three deviates, or a tenth of what it was
        pytest.param(HEALED, GONE._replace(value=2.9), True, id="2.9 deviates"),
        pytest.param(HEALED, GONE._replace(value=-2.9), True, id="2.9 deviates below"),
        pytest.param(HEALED, GONE._replace(value=3.1), False, id="3.1 deviates"),
        pytest.param(HEALED, GONE._replace(value=0.99, std=0.1), True, id="a tenth of what it was"),
        pytest.param(HEALED, GONE._replace(value=1.01, std=0.1), False, id="more than a tenth"),
        # the healthy model leaves no more than noise, and no more than the effect
        pytest.param(HEALED, GONE._replace(without=111.9), True, id="11.9 of the sum of squares are lost"),
        pytest.param(HEALED, GONE._replace(without=112.1), False, id="12.1 of the sum of squares are lost"),
        pytest.param(
            HEALED, GONE._replace(with_effect=149.0, without=149.9), True, id="what is left is 1.499"
        ),
        pytest.param(
            HEALED, GONE._replace(with_effect=149.0, without=150.1), False, id="what is left is 1.501"
        ),
        # the effect would be seen: ten is more than six deviates
        pytest.param(HEALED, GONE._replace(std=1.66), True, id="6.02 deviates would be seen"),
        pytest.param(HEALED, GONE._replace(std=1.67), False, id="5.99 deviates"),
        pytest.param(HEALED, GONE._replace(std=np.inf), False, id="the samples do not tell"),
    ],
)
def test_an_alarm_ends_where_the_effect_is_gone(samples: int, follow: Follow, healed: bool) -> None:
    found = watched(samples, follows=[follow])
    assert (found.state, found.ended) == (("healthy", 1) if healed else ("A", 0))
    assert found.restarts == healed


def test_after_the_end_the_next_change_is_an_alarm_of_its_own() -> None:
    again = HEALED + 23
    options: Any = {"looks": [Look()] * 5 + [ON_C], "follows": [GONE], "crossings": [CROSSED, again]}
    assert watched(again, **options).state == "healthy"
    assert watched(again + 1, **options).state == "waiting"
    found = watched(again + 25, **options)
    assert (found.state, found.rung, found.ended) == ("C", again + 24, 1)
    assert found.monitor.alarm.ended is None
    assert found.monitor.past_alarms[0].ended == HEALED * DT


def test_a_crossing_while_an_alarm_is_on_is_none_of_its_own() -> None:
    found = watched(SECOND + 32, crossings=[CROSSED, CROSSED + 8, SECOND + 7])
    assert (found.state, found.rung, found.ended) == ("A", SECOND - 1, 0)


@pytest.mark.parametrize(("none", "said"), [(49.0, False), (50.3, True), (-np.inf, False)])
def test_a_change_that_is_none_of_the_candidates_is_said(none: float, said: bool) -> None:
    """None of them at more than even odds, and more than the best candidate."""
    found = watched(LAST, [Look((50.0, 0.0, 0.0), none=none)]).monitor
    assert ("none of the candidates" in found.alarm.sentence) == said
    # a change is as probable as (statistic^2 - threshold^2) / 2 says: 22.5
    share = softmax([50.0, 0.0, 0.0, none])[0] / (1.0 + np.exp(-22.5))
    assert found.ranking[0].probability == pytest.approx(share, rel=1e-9)


@pytest.mark.parametrize("none", [-np.inf, 3.0])
@pytest.mark.parametrize("change", [-800.0, -1.0, 0.0, 2.0, 800.0])
@pytest.mark.parametrize("gains", [[0.0], [3.0, 1.0, -5.0], [900.0, 900.0]])
def test_probabilities_are_those_of_bayes(change: float, gains: list[float], none: float) -> None:
    """One half of no change at the threshold; equal priors of the candidates and of none of them."""
    something = 1.0 / (1.0 + np.exp(-np.clip(change, -700, 700)))
    wanted = [1.0 - something, *something * softmax([*gains, none])[:-1]]
    np.testing.assert_allclose(naming.shares(change, np.array(gains), none), wanted, rtol=1e-12, atol=1e-300)


HEALTHY, POINTS = 1000.0, 200
ONE, TWO = rco.Effect("stiffness", "link1"), rco.Effect("clearance", "link1")  # coefficients


def fitted(cost: float, at: int) -> Any:
    return SimpleNamespace(cost=cost, points=POINTS, at=at)


@pytest.mark.parametrize(
    ("fits", "best", "misfit"),
    [
        pytest.param([(200, ONE), (300, ONE)], 0, 1.0, id="the better fit"),
        pytest.param([(700, ONE), (800, ONE)], 0, 3.5, id="what is left weighs all of them less"),
        pytest.param([(196, TWO), (200, ONE)], 1, 0.98, id="a coefficient costs log(200) = 5.3"),
        pytest.param([(189, TWO), (200, ONE)], 0, 0.945, id="a coefficient that earns 11"),
        pytest.param([(200, None), (700, ONE)], 1, 3.5, id="one that is no explanation"),
        pytest.param([(200, None)], 0, 5.0, id="nothing that explains it"),
    ],
)
def test_gains_are_weighed_by_what_the_best_fit_leaves(
    fits: list[tuple[float, Any]], best: int, misfit: float
) -> None:
    """Schwarz's penalty for each further coefficient, and four for a change of unknown form."""
    trials: list[Any] = [
        Fitted(effect or ONE, fitted(float(cost), i), 0.5 * (HEALTHY - cost) * bool(effect))
        for i, (cost, effect) in enumerate(fits)
    ]
    weighed, found, none = naming.weighed(trials, HEALTHY)
    price, temper = 0.5 * np.log(POINTS), max(1.0, misfit)
    assert found == pytest.approx(misfit)
    assert weighed[0].fit.at == best  # type: ignore[attr-defined]
    assert none == pytest.approx(0.5 * (HEALTHY - LEVEL.alarm_left * POINTS) / temper - 4 * price)
    for one in weighed:
        gain = trials[one.fit.at].gain  # type: ignore[attr-defined]
        assert one.gain == pytest.approx(gain / temper - price * (len(one.effect.free) - 1))


@pytest.mark.parametrize(
    ("effect", "theta", "std", "determined"),
    [
        pytest.param(ONE, [3.1], [1.0], True, id="3.1 deviates"),
        pytest.param(ONE, [2.9], [1.0], False, id="2.9 deviates"),
        pytest.param(TWO, [-3.1, 0.1], [1.0, 1.0], True, id="a size"),
        pytest.param(TWO, [1.0, 9.0], [1.0, 1.0], False, id="a gap alone is no size"),
        pytest.param(ONE, [5.0], [np.inf], False, id="nothing is seen"),
    ],
)
def test_a_size_has_to_be_determined(
    effect: Any, theta: list[float], std: list[float], determined: bool
) -> None:
    fit: Any = SimpleNamespace(theta=np.array(theta), std=np.array(std))
    assert Fitted(effect, fit, 1.0).determined == determined


# ------------------------------------------------------------------------- learning
@pytest.mark.parametrize(
    ("missing", "moved", "tolerance", "adequate"),
    [
        pytest.param(None, {}, 0.05, True, id="as given"),
        pytest.param(C, {}, 0.05, False, id="a candidate is missing"),
        pytest.param(None, {"A": 0.098}, 0.05, True, id="9.8 % of tolerance 5"),
        pytest.param(None, {"A": 0.102}, 0.05, False, id="10.2 % of tolerance 5"),
        pytest.param(None, {"A": -0.102}, 0.05, False, id="10.2 % down"),
        pytest.param(None, {"A": 0.102}, 0.06, True, id="10.2 % of tolerance 6"),
        pytest.param(None, {"A": 0.102}, 0.0, True, id="no tolerance asks nothing"),
        pytest.param(C, {"A": 0.102}, 0.05, False, id="both"),
    ],
)
def test_the_learning_phase_judges_the_model(
    missing: Any, moved: dict[str, float], tolerance: float, adequate: bool
) -> None:
    found = naming.judged(((80.0,), (90.0,)), moved, missing, 9.0, tolerance, DT)
    assert (found.missing, found.moved, found.adequate) == (missing, moved, adequate)
    assert ("Next: better = rco.refine" in found.sentence) != adequate
    assert ("is missing" in found.sentence) == (missing is not None)
    assert ("it explains 90.0 %" in found.sentence) == bool(moved)


@pytest.mark.parametrize(
    ("updates", "state"),
    [
        pytest.param([], "learning", id="nothing yet"),
        pytest.param([LEARN - 1], "learning", id="one sample is missing"),
        pytest.param([LEARN], "no alarm", id="all in one block"),
        pytest.param([LEARN - 1, 1], "no alarm", id="in two blocks"),
        pytest.param([LEARN - 1, 2], "no alarm", id="and one sample more"),
        pytest.param([50] * 4, "no alarm", id="in four blocks"),
        pytest.param([LEARN, "reset"], "learning", id="reset"),
        pytest.param([LEARN - 1, "reset", 1], "learning", id="reset forgets what was learned from"),
        pytest.param([LEARN, "reset", LEARN], "no alarm", id="reset and learned again"),
        pytest.param([LEARN - 1, "fails", 1], "no alarm", id="an update that fails is none"),
        pytest.param([LEARN, "fails"], "no alarm", id="one that fails after learning"),
    ],
)
def test_learning_ends_with_its_samples_and_reset_begins_again(updates: list[Any], state: str) -> None:
    learned_from, taken = list[int](), list[int]()

    def learn(base: Any, candidates: Any, period: int, false_alarms: float, block: Any) -> Any:
        learned_from.append(len(block.inputs))
        return SimpleNamespace(block=BLOCK)

    def advance(of: Any, state: State, block: Any, healthy: bool) -> tuple[State, float]:
        taken.append(len(block.inputs))
        return state._replace(blocks=state.blocks + 1), 0.5

    one = rco.Monitor(rco.mass_spring_damper(1.0, 0.4, 100.0), [A], dt=0.05, learn=LEARN)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(monitor, "learn", learn)
        patched.setattr(monitor, "begin", lambda of: State())
        patched.setattr(monitor, "advance", advance)
        patched.setattr(monitor, "found_anew", lambda of, state: state)
        patched.setattr(monitor, "adequacy_of", lambda *_: None)
        patched.setattr(monitor, "history_row", lambda *_: np.zeros(5))
        count = 0
        for what in updates:
            if what == "reset":
                one.reset()
                count = 0
            elif what == "fails":
                with pytest.raises(rco.DataError, match=r"[Nn]a[Nn]|finite|missing"):
                    one.update([0.0, np.nan], [0.0, 0.0])
            else:
                one.update(np.zeros(what), np.zeros(what))
                count += what
    assert repr(one).endswith(f"{count} samples, {state}>")
    assert learned_from == [LEARN] * max(updates.count(LEARN), state == "no alarm")
    assert taken == [BLOCK] * (len(learned_from) * (LEARN // BLOCK))


# ------------------------------------------------------------------------- gaps
GAPS = {
    "xxxxxxxx": "xxxxxxxx",
    "xyxxxxxx": "x.xxxxxx",  # a white output that is missing costs nothing but itself
    "xyyyxxxx": "x...xxxx",
    "xwxxxxxx": "x.......",  # an input is missing: until the state is found anew
}


def counted(pattern: str, pieces: Sequence[int] = (), order: int = 0) -> str:
    """Samples that count (x) of a pattern: x measured, y the output is missing, w the input is missing."""
    h: Any = SimpleNamespace(orders=(order,), gain=np.zeros((1, 1)), scales=np.ones(1))
    of: Any = SimpleNamespace(healthy=h, block=1, error_steps=(0.9 * np.eye(1), np.eye(1)))
    state: Any = SimpleNamespace(
        used=np.ones((order, 1), np.uint8), doubt=np.zeros((1, 1)), lost=-1, blocks=0, level=np.ones(1)
    )
    found = ""
    for a, b in zip([0, *pieces], [*pieces, len(pattern)], strict=True):
        use = np.array([[x != "y"] for x in pattern[a:b]], dtype=np.uint8)
        known = np.array([x != "w" for x in pattern[a:b]], dtype=np.uint8)
        block = score.Block(np.zeros((b - a, 1)), np.zeros((b - a, 1)), known, use)
        calm, state.doubt, state.lost = score._calm(of, state, block)
        state.used, state.blocks = np.concatenate([state.used, use])[b - a :], b
        found += "".join("x" if one else "." for one in calm[:, 0])
    return found


@pytest.mark.parametrize(("pattern", "counts"), GAPS.items())
def test_samples_after_a_gap_count_when_the_state_is_sure(pattern: str, counts: str) -> None:
    assert counted(pattern) == counts
    for cut in range(1, len(pattern)):
        assert counted(pattern, [cut]) == counts


def test_a_filter_needs_a_whole_past() -> None:
    assert counted("xyxxxxxx", order=2) == "x...xxxx"
    assert counted("xyxxxxxx", [3], order=2) == "x...xxxx"


@pytest.mark.parametrize("missing", [1, 10])
def test_an_observer_that_was_not_corrected_is_less_sure(missing: int) -> None:
    """Of a random walk that is not measured, the doubt grows by K^2 R a sample."""
    gain = np.array([[0.618]])
    h: Any = SimpleNamespace(orders=(0,), gain=gain, scales=np.ones(1))
    of: Any = SimpleNamespace(healthy=h, block=1, error_steps=(np.eye(1), np.eye(1)))
    state: Any = SimpleNamespace(
        used=np.ones((0, 1), np.uint8), doubt=np.zeros((1, 1)), lost=-1, blocks=0, level=np.ones(1)
    )
    use: NDArray[np.uint8] = np.zeros((missing, 1), np.uint8)
    block = score.Block(np.zeros((missing, 1)), np.zeros((missing, 1)), np.ones(missing, np.uint8), use)
    _, doubt, _ = score._calm(of, state, block)
    assert doubt[0, 0] == pytest.approx(missing * 0.618**2)
