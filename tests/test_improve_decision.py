"""Which steps `improve` takes: errors of sets of effects on the parts of a record in, steps and words out.

A letter is an effect, a text of letters a set of them. Errors of a set are those on the part that is fitted,
on the part that chooses, and on the held-out part; the model as given has errors of ten.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

import rcorefine as rco
from rcorefine.diagnosis import held_out, improve
from rcorefine.inference.levels import Levels

KINDS = {
    "k": "cubic_stiffness",
    "f": "coulomb_friction",
    "d": "damping",
    "a": "asymmetric_friction",
    "t": "table_force",
}
LETTERS = {kind: letter for letter, kind in KINDS.items()}
EFFECTS = {x: rco.Effect(KINDS[x], "link1") for x in "kfda"}
Errors = Mapping[str, tuple[float, float, float]]
#: What one coefficient must save: log of the error.
EARNED = float(np.exp(-Levels().earned))
LESS, MORE = 0.99, 1.01


class Path(NamedTuple):
    steps: str
    verdict: str
    message: str
    notes: str
    ties: list[str]


class Made(SimpleNamespace):
    """Stands for a trial, as a key too."""

    __hash__ = object.__hash__


def letters(effects: Sequence[Any]) -> str:
    return "".join(sorted((LETTERS[e.kind] for e in effects), key="kfdat".index))


def improved(
    errors: Errors,
    verdict: str = "unexplained",
    chosen: str = "",
    *,
    most: int = 4,
    left: Mapping[str, float] | None = None,
    close: float = np.nan,
    unsure: Sequence[str] = (),
    undetermined: Sequence[str] = (),
    sizes: Mapping[str, int] | None = None,
    evidence: str | None = None,
    beside: bool = False,
    alike: Sequence[str] = (),
    unfolds: Mapping[str, str] | None = None,
    table: tuple[str, float] | None = None,
    with_motion: bool = True,
    offset: Sequence[float] | None = None,
) -> Path:
    """Improve by these errors.

    `chosen` is what the diagnosis names; `left` the largest error that is the model's, by set; `close` what
    the diagnosis is adequate to. Sets of `unsure` have an effect that is not determined, those of
    `undetermined` have one after the refit of two parts. `sizes`: coefficients of a set. `unfolds`: sets that
    a set leads to. `table`: place of a free force, and choice error with it. `offset`: direction in which an
    offset of the model pushes; the effects push in the first one.
    """
    known = dict(errors)

    def model(name: str) -> Any:
        effects = [EFFECTS[x] for x in name if x in EFFECTS]
        roles = ["effect"] * len(effects) + ["linear"] * ("+" in name)
        others = [rco.Effect("stiffness", "link9")] * ("+" in name)
        if offset is not None:
            push = SimpleNamespace(push=lambda linear, place, act: np.array(offset))
            others, roles = (
                [*others, SimpleNamespace(kind="offset", place="u", spec=push)],
                [*roles, "offset"],
            )  # type: ignore[list-item]
        port = SimpleNamespace(name="link1", act=np.array([2.0, 0.0]))
        linear = SimpleNamespace(output_labels=("y",), n_outputs=1)
        return Made(
            name=name,
            rmse=np.array([known[name][0]]),
            of_responses=False,
            roles=roles,
            effects=(*effects, *others),
            physical_model=SimpleNamespace(linear=linear, ports=[port], port=lambda place: port),
        )

    class Held(held_out.HeldOutPath):
        def __init__(self, *_: Any) -> None:
            self.parts: Any = SimpleNamespace(fit=0, choose=1, judge=2, learn=3, remarks=())
            self.steps, self.found, self.said, self.settings = [], 0.0, [], {}
            self.matters = Levels().matters

        def settled(self, refinement: Any) -> Any:
            return refinement

        def _without(self, model_: Any, effects: Any) -> Any:
            gone = letters(list(effects))
            return model("".join(x for x in model_.name if x not in gone))

        def _errors(self, refinement: Any, records: Any) -> Any:
            return np.array([known[refinement.name][records]])

        def errors_on(self, records: Any, model: Any) -> Any:
            share = (left or {}).get(model.name, 1.0)
            # the error of a model is larger on the part that it has not seen
            return (SimpleNamespace(model=share * (1.0 if records == 2 else 0.5), step=0.0, share=share),)

    def trial(name: str) -> Any:
        floated = "+" in name
        nuisances = frozenset("+") if floated else frozenset()
        return Made(
            name=name,
            effects=tuple(EFFECTS[x] for x in name if x in EFFECTS),
            log_evidence={0.0: 0.0},
            hypothesis=SimpleNamespace(
                ratio=0.1 * ("~" in name), floated=floated, nuisances=nuisances, spread=1.0
            ),
            model=SimpleNamespace(refinement=model(name)),
            n_coefficients=(sizes or {}).get(name, len(name.strip("+~"))),
        )

    class Searched:
        not_afforded = ""

        def __init__(self, *_: Any, **__: Any) -> None:
            later = set((unfolds or {}).values())
            self.trials = [trial(name) for name in errors if name not in later]

        def run(self) -> Any:
            return self

        def ranked(self) -> Any:
            return list(self.trials)

        def determined(self, one: Any) -> bool:
            return one.name not in unsure

        def climbed(self, one: Any) -> None:
            new = (unfolds or {}).get(one.name)
            if new and all(t.name != new for t in self.trials):
                self.trials.append(trial(new))

        def base(self, nuisances: Any) -> Any:
            return SimpleNamespace(refinement=model("+"))

    progress = SimpleNamespace(step=lambda name: nullcontext())
    case: Any = SimpleNamespace(
        base=model(""),
        levels=Levels(),
        progress=progress,
        records=[],
        in_time=with_motion,
        ordered=[SimpleNamespace(error_units=("",))],
    )
    best = model(chosen)
    row = SimpleNamespace(effects=tuple(EFFECTS[x] for x in chosen if x in EFFECTS), refinement=best)
    others = [SimpleNamespace(effects=tuple(EFFECTS[x] for x in name), alike=True) for name in alike]
    found: Any = SimpleNamespace(
        verdict=verdict,
        notes=(),
        checks=(),
        adequate_to=close,
        base=model("+" if beside else ""),
        effects=row.effects,
        ranking=[row, *others],
        best=row if row.effects else None,
        floated=best if "+" in chosen and not row.effects else None,
    )
    free: Any = None
    if table is not None:
        unknown = Made(
            kind="table_force", place=table[0], label="table", spec=SimpleNamespace(with_offset="")
        )
        free = SimpleNamespace(law=SimpleNamespace(effect=unknown))

    def tabulated(last: Any, *_: Any, **__: Any) -> Any:
        assert table is not None
        known[last.name + "t"] = (1.0, table[1], 1.0)
        return model(last.name + "t")

    def loose(one: Any, effects: Any) -> bool:
        return one.name in undetermined and bool(effects)

    def sizes_of(one: Any, effect: Any) -> Any:
        return {str(i): 1.0 for i in range((sizes or {}).get(letters([effect]), 1))}, {}

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(improve, "HeldOutPath", Held)
        patched.setattr(improve, "split_in_parts", lambda *_: None)
        patched.setattr(improve, "case_of_part", lambda *_: (None, None))
        patched.setattr(improve, "Search", Searched)
        patched.setattr(improve, "open_force", lambda search: (free, None))
        patched.setattr(improve, "refine", tabulated)
        patched.setattr(improve, "parameters_off", lambda one, levels: "+" in one.name)
        for module in (improve, held_out):
            patched.setattr(module, "loose", loose)
        patched.setattr(held_out, "sizes_of", sizes_of)
        asked: Any = SimpleNamespace(found=found, case=case, model=None, validation=None)
        result = improve._Improver(asked, most).improvement()
    names = {"start": "0", "parameters": "+"}
    steps = "".join(names[s.action] if s.effect is None else letters([s.effect]) for s in result.steps)
    ties = [letters(s.rivals) for s in result.steps]
    return Path(steps, result.verdict, result.message, " ".join(result.notes), ties)


START = (10.0, 10.0, 10.0)


@pytest.mark.parametrize(
    ("errors", "options", "steps", "verdict", "message"),
    [
        pytest.param(
            {"": START},
            {"verdict": "adequate"},
            "0",
            "adequate",
            "No residual test is significant: this",
            id="nothing",
        ),
        pytest.param(
            {"": START, "k": (1, 1, 1)},
            {"verdict": "effect", "chosen": "k"},
            "0k",
            "adequate",
            "No residual test is significant.",
            id="the effect of the diagnosis",
        ),
        pytest.param(
            {"": START, "k": (1, 1, 1)},
            {"verdict": "ambiguous", "chosen": "k"},
            "0k",
            "adequate",
            "No residual test is significant.",
            id="the likeliest of several",
        ),
        pytest.param(
            {"": START, "k": (9, 9, 11)},
            {"verdict": "effect", "chosen": "k"},
            "0k",
            "adequate",
            "No residual",
            id="what the diagnosis names stays, even if the held-out error grows",
        ),
        pytest.param(
            {"": START, "+": (1, 1, 1)},
            {"verdict": "parameters", "chosen": "+"},
            "0+",
            "adequate",
            "No residual test is significant.",
            id="parameters alone",
        ),
        pytest.param(
            {"": START, "+": (5, 5, 5), "k": (1, 1, 1)},
            {"verdict": "effect", "chosen": "k", "beside": True},
            "0+k",
            "adequate",
            "No residual",
            id="parameters, then the effect",
        ),
        pytest.param(
            {"": START, "k": (2, 9, 9), "f": (5, 9, 9), "kf": (1, 1, 1)},
            {"verdict": "effect", "chosen": "kf"},
            "0kf",
            "adequate",
            "No residual",
            id="first the one without which the error is larger",
        ),
        pytest.param(
            {"": START, "k": (5, 9, 9), "f": (2, 9, 9), "kf": (1, 1, 1)},
            {"verdict": "effect", "chosen": "kf"},
            "0fk",
            "adequate",
            "No residual",
            id="the other way round",
        ),
        pytest.param(
            {"": START, "k": (1, 1, 1)},
            {"verdict": "effect", "chosen": "k", "most": 0},
            "0",
            "unexplained",
            "Stopped at max_effects = 0",
            id="no effect is allowed",
        ),
        pytest.param(
            {"": START, "k": (1, 1, 1)},
            {"verdict": "effect", "chosen": "k", "close": 0.0031},
            "0k",
            "adequate",
            "The model is adequate to 0.31 %",
            id="too little to matter",
        ),
        pytest.param(
            {"": START, "k": (1, 1, 1)},
            {"chosen": "k", "close": 0.006, "left": {"k": 0.006}},
            "0k",
            "unexplained",
            "The residual is not noise, but the error of the model is at most 0.6 % of the motion, less than "
            "what matters (1 %)",
            id="unexplained but close",
        ),
        pytest.param(
            {"": START, "k": (1, 1, 1)},
            {"chosen": "k", "close": 0.006, "left": {"k": 0.02}},
            "0k",
            "unexplained",
            "The residual is not noise, but the error of the model is at most 2 % of the motion. It may",
            id="close before",
        ),
    ],
)
def test_the_path_to_the_set_of_the_diagnosis(
    errors: Errors, options: dict[str, Any], steps: str, verdict: str, message: str
) -> None:
    found = improved(errors, **options)
    assert (found.steps, found.verdict) == (steps, verdict)
    assert found.message.startswith(message)


@pytest.mark.parametrize(("held_out_error", "noted"), [(9.9, False), (10.1, True)])
def test_a_held_out_error_that_did_not_decrease_is_noted(held_out_error: float, noted: bool) -> None:
    found = improved({"": START, "k": (1, 1, held_out_error)}, "effect", "k")
    assert ("did not decrease" in found.notes) == noted


NONE, OTHER, FULL = "No other set", "Removed: ", "Stopped at max_effects"
CLOSE = "The residual is not noise, but"


@pytest.mark.parametrize(
    ("errors", "options", "steps", "message"),
    [
        pytest.param({"": START}, {}, "0", NONE, id="no set"),
        pytest.param({"": START, "k": (5, 5, 5)}, {}, "0k", NONE, id="half the error"),
        pytest.param(
            {"": START, "k": (10, 5, 5), "f": (10, 6, 5)}, {}, "0k", NONE, id="the smaller error that chooses"
        ),
        pytest.param(
            {"": START, "k": (5, 5, 5), "f": (3, 6, 5)},
            {},
            "0f",
            NONE,
            id="the mean of the logarithms: 25 of 18",
        ),
        pytest.param(
            {"": START, "k": (5, 5, 9), "f": (6, 6, 1)},
            {},
            "0k",
            NONE,
            id="the held-out part chooses nothing",
        ),
        # each coefficient must save 5 %
        pytest.param(
            {"": START, "k": (10 * EARNED * LESS,) * 2 + (5,)}, {}, "0k", NONE, id="5.9 % for one coefficient"
        ),
        pytest.param(
            {"": START, "k": (10 * EARNED * MORE,) * 2 + (5,)}, {}, "0", NONE, id="3.9 % for one coefficient"
        ),
        pytest.param(
            {"": START, "k": (10 * EARNED**2 * LESS,) * 2 + (5,)},
            {"sizes": {"k": 2}},
            "0k",
            NONE,
            id="10 % for two",
        ),
        pytest.param(
            {"": START, "k": (10 * EARNED**2 * MORE,) * 2 + (5,)},
            {"sizes": {"k": 2}},
            "0",
            NONE,
            id="8 % for two",
        ),
        pytest.param(
            {"": START, "k": (5, 10 * EARNED * MORE, 5)},
            {},
            "0",
            NONE,
            id="3.9 % on the part that chooses is cut",
        ),
        pytest.param(
            {"": START, "k": (5, 10 * EARNED * LESS, 5)}, {}, "0k", NONE, id="5.9 % on the part that chooses"
        ),
        pytest.param(
            {"": START, "k": (5, 5, 5), "f": (9, 9, 9), "kf": (4.9, 4.9, 4)},
            {},
            "0k",
            NONE,
            id="2 % by a second one",
        ),
        pytest.param(
            {"": START, "k": (5, 5, 5), "f": (9, 9, 9), "kf": (4.6, 4.6, 4)},
            {},
            "0kf",
            NONE,
            id="8 % by a second one",
        ),
        pytest.param(
            {"": START, "k": (5, 5, 5), "f": (9, 9, 9), "kf": (4, 4.9, 4)},
            {},
            "0k",
            NONE,
            id="a second one that chooses little is cut",
        ),
        pytest.param({"": START, "k": (10.5, 9.2, 5)}, {}, "0", NONE, id="1.7 % of the mean for one"),
        pytest.param(
            {"": START, "k": (9.6, 8.7, 5)}, {"sizes": {"k": 2}}, "0", NONE, id="9 % of the mean for two"
        ),
        # the held-out part takes back
        pytest.param({"": START, "k": (5, 5, 9.9)}, {}, "0k", NONE, id="a held-out error of 9.9"),
        pytest.param({"": START, "k": (5, 5, 10)}, {}, "0k", NONE, id="a held-out error of 10"),
        pytest.param(
            {"": START, "k": (5, 5, 10.1)}, {}, "0", "Removed: add cubic", id="a held-out error of 10.1"
        ),
        pytest.param(
            {"": START, "k": (5, 5, 5), "f": (9, 9, 9), "kf": (3, 3, 11)},
            {},
            "0k",
            "Removed: add coulomb",
            id="the last of two",
        ),
        pytest.param(
            {"": START, "k": (5, 5, 11), "f": (9, 9, 9), "kf": (3, 3, 12)},
            {},
            "0",
            "Removed: add cubic_stiffness at link1, add coulomb",
            id="both",
        ),
        pytest.param(
            {"": START, "k": (5, 5, 11), "f": (9, 9, 9), "kf": (3, 3, 9)},
            {},
            "0kf",
            NONE,
            id="a first step alone may be worse",
        ),
        # effects must be determined
        pytest.param(
            {"": START, "k": (2, 2, 2), "f": (5, 5, 5)},
            {"unsure": "k"},
            "0f",
            NONE,
            id="the next that is determined",
        ),
        pytest.param({"": START, "k": (2, 2, 2)}, {"unsure": "k"}, "0", NONE, id="none that is determined"),
        pytest.param(
            {"": START, "k": (2, 2, 2), "f": (5, 5, 5)},
            {"undetermined": "k"},
            "0f",
            NONE,
            id="not determined by two parts",
        ),
        pytest.param(
            {"": START, "k": (5, 5, 5), "f": (9, 9, 9), "kf": (3, 3, 3)},
            {"undetermined": ["k"]},
            "0kf",
            NONE,
            id="a step between is not asked",
        ),
        # re-estimated parameters
        pytest.param(
            {"": START, "+": (6, 6, 6), "k+": (3, 3, 3)}, {}, "0+k", NONE, id="parameters and an effect"
        ),
        pytest.param(
            {"": START, "k~": (3, 3, 3), "k": (5, 5, 5)}, {}, "0k", NONE, id="process noise is no step"
        ),
        # the search goes on from what is best
        pytest.param(
            {"": START, "k": (5, 5, 5), "f": (9, 9, 9), "kf": (3, 3, 3)},
            {"unfolds": {"k": "kf"}},
            "0kf",
            NONE,
            id="on from the best one",
        ),
        pytest.param(
            {"": START, "k": (5, 5, 5), "f": (9, 9, 9), "kf": (3, 3, 3)},
            {"unfolds": {"f": "kf"}},
            "0k",
            NONE,
            id="not from another one",
        ),
        pytest.param(
            {"": START, "k": (5, 5, 5), "f": (9, 9, 9), "kf": (3, 3, 3)},
            {"unfolds": {"k": "kf"}, "most": 2},
            "0kf",
            FULL,
            id="as many as are allowed",
        ),
        pytest.param({"": START, "k": (5, 5, 5)}, {"most": 1}, "0k", FULL, id="one is allowed"),
        pytest.param({"": START, "k": (5, 5, 5)}, {"most": 2}, "0k", NONE, id="fewer than are allowed"),
        pytest.param(
            {"": START, "k": (5, 5, 5), "f": (9, 9, 9), "d": (9, 9, 9), "kf": (3, 3, 3), "fd": (9, 9, 9)}
            | {"kd": (9, 9, 9), "kfd": (1, 1, 1)},
            {"unfolds": {"k": "kf", "kf": "kfd"}},
            "0kfd",
            NONE,
            id="on from the best two",
        ),
        # too little to matter
        pytest.param(
            {"": START, "k": (5, 5, 5)}, {"left": {"k": 0.0099}}, "0k", CLOSE, id="an error of .99 %"
        ),
        pytest.param(
            {"": START, "k": (5, 5, 5)}, {"left": {"k": 0.0101}}, "0k", NONE, id="an error of 1.01 %"
        ),
        pytest.param(
            {"": START, "k": (5, 5, 11)}, {"left": {"": 0.009}}, "0", CLOSE, id="close after a step back"
        ),
        # a table for the force that is left
        pytest.param(
            {"": START},
            {"table": ("link2", 10 * EARNED * LESS)},
            "0t",
            "No other set of effects reduces the held-out error enough. The force at link2 is unknown",
            id="a table that saves 5.9 %",
        ),
        pytest.param(
            {"": START}, {"table": ("link2", 10 * EARNED * MORE)}, "0", NONE, id="a table that saves 3.9 %"
        ),
        pytest.param(
            {"": START, "k": (5, 5, 5)},
            {"table": ("link1", 1.0)},
            "0k",
            NONE,
            id="a table at the place of an effect",
        ),
        pytest.param(
            {"": START, "k": (5, 5, 5)}, {"table": ("link2", 1.0)}, "0kt", NONE, id="a table at another place"
        ),
        pytest.param(
            {"": START, "k": (5, 5, 5)},
            {"table": ("link2", 1.0), "most": 1},
            "0k",
            FULL,
            id="a table is a step",
        ),
        pytest.param(
            {"": START},
            {"table": ("link2", 1.0), "with_motion": False},
            "0",
            NONE,
            id="responses have no table",
        ),
        pytest.param(
            {"": START}, {"table": ("link2", 1.0), "left": {"": 0.001}}, "0", CLOSE, id="close needs no table"
        ),
        pytest.param(
            {"": START, "k": (5, 5, 5)},
            {"table": ("link2", 1.0), "undetermined": ["kt"]},
            "0k",
            NONE,
            id="a table that is not determined",
        ),
    ],
)
def test_the_path_by_the_error_where_no_set_is_named(
    errors: Errors, options: dict[str, Any], steps: str, message: str
) -> None:
    found = improved(errors, **options)
    assert found.steps == steps
    assert found.message.startswith(message)
    assert found.verdict == "unexplained"


@pytest.mark.parametrize(
    ("chosen", "options", "ties"),
    [
        pytest.param("k", {}, [""], id="no other set"),
        pytest.param("k", {"alike": ["f"]}, ["f"], id="one in its place"),
        pytest.param("k", {"alike": ["f", "d"]}, ["fd"], id="two in its place"),
        pytest.param("k", {"alike": ["fd"]}, [""], id="two for one are no exchange"),
        pytest.param("kf", {"alike": ["kd"]}, ["", "d"], id="the one that is exchanged"),
        pytest.param(
            "f", {"offset": [1.0, 0.0]}, ["a"], id="friction beside an offset of the same direction"
        ),
        pytest.param("f", {"offset": [-1.0, 0.0]}, ["a"], id="of the opposite direction"),
        pytest.param("f", {"offset": [1.0, 0.1]}, [""], id="of another direction"),
        pytest.param("k", {"offset": [1.0, 0.0]}, [""], id="a spring is no other friction"),
        pytest.param("fa", {"offset": [1.0, 0.0]}, ["", ""], id="the other one is there already"),
    ],
)
def test_effects_that_the_data_cannot_distinguish_from_a_step(
    chosen: str, options: dict[str, Any], ties: list[str]
) -> None:
    errors = {"": START, chosen: (1.0, 1.0, 1.0)} | {x: (5.0 - i, 5.0, 5.0) for i, x in enumerate(chosen)}
    errors[chosen] = (1.0, 1.0, 1.0)
    found = improved(errors, "effect", chosen, **options)
    assert sorted(found.ties[1:]) == sorted(ties)
    assert ("by another name" in found.notes) == (ties == ["a"])


def test_a_diagnosis_without_motion_is_an_error() -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(improve, "HeldOutPath", lambda *_: None)
        patched.setattr(improve, "split_in_parts", lambda *_: None)
        found = SimpleNamespace(verdict="ambiguous", ranking=[], notes=["Nothing moves."])
        case = SimpleNamespace(records=[])
        asked: Any = SimpleNamespace(found=found, case=case, model=None, validation=None)
        with pytest.raises(rco.DataError, match="Nothing moves"):
            improve._Improver(asked, 4).improvement()
