"""Commands `check`, `compare`, `diagnose`, `improve`, `survey`, ...

Each command reads the files, computes, prints, draws, and writes the report.
"""

from __future__ import annotations

import inspect
import json
import os
import re
import shlex
import signal
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from typing import Any

import control as ct

from ..arguments import printable
from ..comparison.compare import compare
from ..comparison.result import best_of, failures_of
from ..data import channels
from ..data.measurement import Measurement
from ..diagnosis.check import check
from ..diagnosis.check_rows import Check
from ..diagnosis.diagnose import diagnose
from ..diagnosis.improve import improve
from ..diagnosis.result import Diagnosis, Improvement, next_step
from ..effects.effect import Effect
from ..exceptions import DataError, ModelError, needed
from ..fleet.pieces import model_for
from ..fleet.result import Survey
from ..fleet.survey import ASKED, survey
from ..models.library import effect_library
from ..models.reading import read_model
from ..version import __version__
from ..views.code import comment
from ..views.content import content
from ..views.data import plain
from ..views.page import check_target, fingerprint
from ..views.tables import wrapped
from ..writing import replacing


def _record_object(data: Measurement) -> dict[str, Any]:
    """Name, size and fingerprint of a record."""
    prints = {"sha256_inputs": fingerprint(data.inputs), "sha256_outputs": fingerprint(data.outputs)}
    known = {"name": data.name, "samples": data.n_samples, "dt": data.dt, "hold": data.hold}
    return known | {"inputs": data.input_labels, "outputs": data.output_labels} | prints


#: Options that the next command does not take over, and whether a value follows.
_OWN = dict.fromkeys(
    ("--picture", "--report", "--csv", "--candidates", "--effects", "--significance", "--matters",
     "--max-effects", "--x0", "--free", "--validation", "--split"), True
) | {"--json": False, "--overwrite": False}  # fmt: skip


def run_compare(arguments: Namespace) -> int:
    """Compare one or several models with a record.

    Parameters
    ----------
    arguments : Namespace
        Parsed command line.

    Returns
    -------
    int
        1 where the best of the models fails somewhere, otherwise 0.
    """
    check_targets(arguments)
    models = [read_model(path) for path in arguments.models]
    data, held_out = fitted_and_held_out(models[0], arguments)
    record = data if held_out is None else held_out
    one = len(models) == 1
    result = compare(models[0] if one else models, record, x0=arguments.x0, horizon=arguments.horizon)
    failures = failures_of(result, best_of(result))
    sentences, _ = content(result).answer()
    return finish(arguments, bool(failures), sentences, result, record, text=f"{result}\n{failures}")


def run_check(arguments: Namespace) -> int:
    """Check a record and a model beside it.

    Return 1 if something must be corrected first.
    """
    model, data, _ = opened(arguments)
    found = check(model, data)
    title = [f"{row.status.upper()}: {row.sentence}" for row in found.looks[:3]] or ["No problem found"]
    draw = partial(data.plot, title="\n".join(wrapped(title)))
    return finish(arguments, found.stops, [row.sentence for row in found.looks], found, data, draw=draw)


def run_diagnose(arguments: Namespace) -> int:
    """Find the effect that a model lacks.

    Arguments and exit codes are those of `run_compare`.
    """
    model, data, validation = opened(arguments)
    found = diagnose(model, data, validation=validation, **_options(arguments, model))
    sentences, fine = content(found).answer()
    return finish(arguments, not fine, sentences, found, data)


def run_improve(arguments: Namespace) -> int:
    """Add one effect after the other; arguments and codes as `run_compare`."""
    model, data, validation = opened(arguments)
    options = _options(arguments, model)
    improvement = improve(model, data, validation=validation, max_effects=arguments.max_effects, **options)
    sentences, fine = content(improvement).answer()
    text, shown = f"{improvement}\n{improvement.refinement}", data if validation is None else validation
    return finish(arguments, not fine, sentences, improvement, data, text=text, beside=shown)


def opened(arguments: Namespace) -> tuple[Any, Measurement, Measurement | None]:
    """Return the model, the record to fit, and the held-out record, if any.

    The files to be written are checked first.
    """
    check_targets(arguments)
    model = read_model(arguments.model)
    return model, *fitted_and_held_out(model, arguments)


def read_record(path: Path, model: Any, arguments: Namespace) -> Measurement:
    """Record for a model; see `rcorefine.data.channels.read_record`.

    Parameters
    ----------
    path : Path
        File.
    model : StateSpace or PhysicalModel
        Model whose signals are looked for where the command line names none.
    arguments : Namespace
        ``input``, ``output`` (lists of names or None), ``time``, ``dt``, ``hold``.

    Returns
    -------
    Measurement

    Raises
    ------
    DataError
        If the file is of another kind, or a column is missing; with the option that would help.
    """
    try:
        return channels.read_record(path, model, **reading(arguments))
    except DataError as error:
        no_time = re.search("no (column|variable) 'time'", str(error))
        hint = ""
        if arguments.time is None and arguments.dt is None and no_time:
            hint = " (name the column of times with --time, or give the sampling time with --dt)"
        elif path.suffix.lower() in channels.SUFFIXES and None in (arguments.input, arguments.output):
            hint = " (name the columns with --input and --output, in the order of the model's signals)"
        raise DataError(f"{error}{hint}") from error


def reading(arguments: Namespace) -> dict[str, Any]:
    """Return the options for the columns as `read_record` takes them.

    See `rcorefine.data.channels.read_record`.
    """
    return {
        "inputs": arguments.input,
        "outputs": arguments.output,
        "time": arguments.time,
        "dt": arguments.dt,
        "hold": arguments.hold,
        "decimal": arguments.decimal,
    }


def fitted_and_held_out(model: Any, arguments: Namespace) -> tuple[Measurement, Measurement | None]:
    """The record to work on and the one to judge by, if any.

    Parameters
    ----------
    model : StateSpace or PhysicalModel
        Model.
    arguments : Namespace
        As `read_record`, and ``data``, ``validation`` (path or None), ``split`` (share or None).

    Returns
    -------
    data, validation : Measurement, Measurement or None
    """
    data = read_record(arguments.data, model, arguments)
    if arguments.validation is not None:
        return data, read_record(arguments.validation, model, arguments)
    if arguments.split is not None:
        return data.split(arguments.split)
    return data, None


def wanted_candidates(model: Any, wanted: Sequence[str] | None) -> list[Effect] | None:
    """Effects that the command line names.

    Parameters
    ----------
    model : StateSpace or PhysicalModel
        Model.
    wanted : sequence of str or None
        Kinds, places, or ``kind@place``; None for all that are plausible.

    Returns
    -------
    list of Effect or None

    Raises
    ------
    ModelError
        If a word is neither kind nor place.

    Examples
    --------
    >>> chain = rco.mass_spring_damper([1.0, 1.0], [1.0, 1.0], [50.0, 50.0])
    >>> [effect.label for effect in wanted_candidates(chain, ["coulomb_friction@link2", "hysteresis@link1"])]
    ['coulomb_friction at link2', 'hysteresis at link1']
    """
    if not wanted:
        return None
    library = effect_library(model)
    places = dict.fromkeys(effect.place for effect in library)
    found: list[Effect] = []
    for word in wanted:
        kind, at, place = word.partition("@")
        if not at and word in places:
            found += [effect for effect in library if effect.place == word]
            continue
        try:
            found += effect_library(model, kinds=kind, places=place or None)
        except ct.ControlArgument as error:
            raise ModelError(
                f"no candidate {word!r}: {error}. Or give places ({', '.join(places)}) or kind@place"
            ) from None
    return list(dict.fromkeys(found))


def _options(arguments: Namespace, model: Any) -> dict[str, Any]:
    return {
        "candidates": wanted_candidates(model, arguments.candidates),
        **fit_options(arguments),
        "significance": arguments.significance,
        "matters": arguments.matters,
        "progress": sys.stderr.isatty() and not arguments.json,
    }


def fit_options(arguments: Namespace) -> dict[str, Any]:
    """Return the options of the fit as `refine` takes them.

    They state which parameters are free and what is known of the record.
    """
    free, noise = arguments.free or (), arguments.noise
    return {
        "free": "linear" if list(free) == ["linear"] else free,
        "tolerance": arguments.tolerance,
        "offset": arguments.offset,
        "noise": noise[0] if noise is not None and len(noise) == 1 else noise,
        "horizon": arguments.horizon,
    }


def check_targets(arguments: Namespace) -> None:
    """Check before the work that report, picture and table can be written."""
    if arguments.report is not None:
        check_target(arguments.report, overwrite=arguments.overwrite)
    check_folders(arguments)


def check_folders(arguments: Namespace) -> None:
    """Check before the work that the folders of picture and table exist."""
    for path in (arguments.picture, arguments.csv):
        if path is not None and not path.absolute().parent.is_dir():
            raise FileNotFoundError(f"the folder {path.absolute().parent} does not exist; make it first")


def finish(
    arguments: Namespace,
    code: int,
    sentences: Sequence[str],
    result: Any,
    data: Measurement | None = None,
    *,
    text: str | None = None,
    content: dict[str, Any] | None = None,
    draw: Callable[[], Any] | None = None,
    beside: Measurement | None = None,
) -> int:
    """Write the report and the picture, then say what was found.

    Parameters
    ----------
    arguments : Namespace
        Parsed command line.
    code : int
        Exit code.
    sentences : sequence of str
        The answer, for JSON.
    result : Result
        What was found.
    data : Measurement, optional
        Record that it rests on.
    text, content, draw : str, dict, callable, optional
        What is printed, what JSON holds, and what draws, where these are not the result's own.
    beside : Measurement, optional
        Record of the report.

    Returns
    -------
    int
        The exit code.
    """
    report: Path | None = None
    if arguments.report is not None:
        line = f"# in a terminal:\n{comment(f'rcorefine {shlex.join(arguments.words)}')}"
        more = {} if beside is None else {"data": beside}
        report = result.report(arguments.report, code=line, overwrite=arguments.overwrite, **more)
    if arguments.picture is not None:
        _write_picture(draw or result.plot, arguments.picture)
    if arguments.json:
        head: dict[str, Any] = {"command": arguments.command, "rcorefine": __version__}
        head |= {"exit_code": int(code), "answer": list(sentences)}
        head |= {} if data is None else {"record": _record_object(data)}
        head |= result.to_dict() if content is None else content
        head["report"] = None if report is None else str(report)
        said = json.dumps(plain(head), allow_nan=False, ensure_ascii=True)
    else:
        said = _for_terminal(str(result) if text is None else text, arguments, result)
        written = {"Report": report, "Picture": arguments.picture}
        said += "".join(f"\n{what}: {path}" for what, path in written.items() if path is not None)
    try:
        sys.stdout.write(said + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # the reader left (rcorefine compare ... | head); what was found is still in the exit code
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return int(code)


def _for_terminal(said: str, arguments: Namespace, result: Any) -> str:
    """Return the text with the next step as a terminal command."""
    if isinstance(result, Diagnosis | Improvement):
        python = "\n".join(wrapped([f"Next: {next_step(result)}"]))
        said = said.replace(f"\n{python}", "")
    words = _next_words(arguments, result)
    return f"{said}\nNext: rcorefine {printable(shlex.join(words))}" if words else said


def _next_words(arguments: Namespace, result: Any) -> list[str]:
    """Return the words of the next command.

    They include the files and the record options that were given.
    """
    verb = "diagnose" if arguments.command in ("check", "compare") else ""
    more: list[str] = []
    if (isinstance(result, Check) and result.stops) or len(getattr(arguments, "models", [0])) > 1:
        return []
    if isinstance(result, Diagnosis):
        named = ",".join(f"{e.kind}@{e.place}" for e in result.effects)
        verb, more = {
            "adequate": ("compare", ["--picture", "compare.png"]),
            "parameters": ("refine", ["--free", "linear"]),
            "unexplained": ("improve", []),
        }.get(result.verdict, ("refine", ["--effects", named]))
    if not verb:
        return []
    kept, words = [], iter(arguments.words[1:])
    for word in words:
        option = word.partition("=")[0]
        if option in _OWN:
            if _OWN[option] and "=" not in word:
                next(words, None)
        else:
            kept.append(word)
    return [verb, *kept, *more]


def _write_picture(draw: Callable[[], Any], path: Path) -> None:
    """By its suffix: PNG, SVG or PDF."""
    import matplotlib.pyplot as plt

    figure = draw().figure
    with replacing(path) as stream:
        figure.savefig(stream, format=path.suffix.lower()[1:], dpi=120)
    plt.close(figure)


def run_survey(arguments: Namespace) -> int:
    """Examine a folder of records.

    Parameters
    ----------
    arguments : Namespace
        Parsed command line.

    Returns
    -------
    int
        With conditions 1 where one is not kept; without, 1 where anything was found or failed. Interrupted,
        what was done is printed, and 130 returned.
    """
    check_folders(arguments)
    try:
        with _workers(arguments) as executor:
            found = survey(
                arguments.model,
                arguments.folder,
                arguments.task,
                executor=executor,
                effects=arguments.compare,
                options=_survey_options(arguments),
                reading=reading(arguments),
                significance=arguments.significance,
                progress=sys.stderr.isatty() and not arguments.json,
            )
    except KeyboardInterrupt as stop:
        if not getattr(stop, "survey", None):
            raise
        return _say(arguments, stop.survey, 130)  # type: ignore[attr-defined]
    if len(found.failed) == len(found.rows):
        first = found.failed[0]
        raise DataError(
            f"no record could be examined; the first was {first.record} of {first.machine}: {first.error}"
        )
    return _say(arguments, found, None)


def _say(arguments: Namespace, found: Survey, code: int | None) -> int:
    broken = found.breaches(arguments.conditions) if arguments.conditions else ()
    if code is None:
        code = int(bool(broken) if arguments.conditions else found.finds)
    lines = [f"NOT KEPT {b.condition}: {': '.join(filter(None, (b.machine, b.sentence)))}" for b in broken]
    content = found.to_dict() | {"breaches": [asdict(b) for b in broken]}
    text = "\n".join([str(found), *lines])
    return finish(arguments, code, found.sentences(), found, text=text, content=content)


def _survey_options(arguments: Namespace) -> dict[str, Any]:
    """Those of the task, as far as it has them."""
    candidates = None
    if arguments.candidates:
        candidates = wanted_candidates(model_for(arguments.model), arguments.candidates)
    given = {"candidates": candidates, "effects": candidates or []} | fit_options(arguments)
    given |= {"significance": arguments.significance, "matters": arguments.matters}
    return {key: given[key] for key in inspect.signature(ASKED[arguments.task]).parameters if key in given}


@contextmanager
def _workers(arguments: Namespace) -> Iterator[Any]:
    """A client of the scheduler, a pool of processes, or None."""
    if arguments.scheduler is not None:
        Client = needed("distributed", "distributed", "--scheduler").Client
        with Client(arguments.scheduler, set_as_default=False) as client:
            yield client
    elif arguments.jobs > 1:
        resource_tracker.ensure_running()  # where it is started later, signals are let through again
        with ProcessPoolExecutor(arguments.jobs, _Quiet()) as pool:
            try:
                yield pool
            except KeyboardInterrupt:
                for worker in list((pool._processes or {}).values()):  # nobody waits for what they do
                    worker.terminate()
                raise
    else:
        yield None


class _Worker(SpawnProcess):
    """Worker process that Ctrl-C does not interrupt.

    A terminal sends Ctrl-C to all its processes; the process that started the worker ends it.
    """

    def start(self) -> None:
        if not hasattr(signal, "pthread_sigmask"):
            return super().start()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # which the new process inherits
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Quiet(SpawnContext):
    Process = _Worker
