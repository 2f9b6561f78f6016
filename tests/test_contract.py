"""What every public result keeps: text of 80 columns, HTML, pickle, strict JSON, a table, picture, report.

Each result is made once, by the cached functions of `public_calls`.
"""

from __future__ import annotations

import json
import pickle
import re
from html.parser import HTMLParser

import control as ct
import matplotlib.pyplot as plt
import pytest
from inner import Data

import rcorefine as rco
from tests import public_calls
from tests.public_calls import RESULTS


def test_every_public_result_is_here():
    """What the reference lists as a result is tried below."""
    kinds = {name for name in rco.__all__ if isinstance(getattr(rco, name), type)}
    assert {name for name in kinds if issubclass(getattr(rco, name), Data)} == set(RESULTS)


OTHERS = {
    "FailureMap": lambda: public_calls.comparison().failures,
    "FrequencyComparison": public_calls.in_frequency,
    "ExperimentAdvice": public_calls.advice,
    "HiddenForce": lambda: public_calls.diagnosis().hidden_force,
    "Detectable": lambda: rco.diagnose(public_calls.model(), public_calls.record()).detectable[0],
    "RankedEffect": lambda: public_calls.diagnosis().best,
    "FTest": lambda: public_calls.diagnosis().tests[0],
    "Step": lambda: public_calls.improvement().steps[-1],
    "DamageRow": lambda: public_calls.damage_map().rows[0],
    "SurveyRow": lambda: public_calls.surveyed().rows[0],
    "FleetEffect": lambda: public_calls.surveyed().effects[0],
    "MonitorRow": lambda: public_calls.watched().ranking[0],
    "Failure": lambda: rco.compare(public_calls.model(), public_calls.small_record(1, 20.0)).failures[0],
    "RecordEstimate": lambda: public_calls.confirmation().estimates[0],
}


EVERY = {**RESULTS, **OTHERS}
#: Those that print in words, show HTML and write a report; and those with a picture.
SHOWN = [name for name in RESULTS if hasattr(getattr(rco, name), "report")]
SHOWN += ["FailureMap", "FrequencyComparison", "ExperimentAdvice", "HiddenForce"]
DRAWN = [name for name in RESULTS if hasattr(getattr(rco, name), "plot")]
DRAWN += ["FrequencyComparison", "ExperimentAdvice", "HiddenForce"]


@pytest.mark.parametrize("name", EVERY)
def test_strict_json_and_a_table(name):
    made = EVERY[name]()
    content = made.to_dict()
    text = json.dumps(content, allow_nan=False)  # raises where a number is not finite
    assert json.loads(text) == content
    assert content
    assert not any(key.startswith("_") for key in content)
    frame = made.to_dataframe()
    assert len(frame) > 0
    assert not any(isinstance(cell, list | dict) for column in frame for cell in frame[column])


@pytest.mark.parametrize("name", EVERY)
def test_a_pickle_says_the_same(name):
    made = EVERY[name]()
    again = pickle.loads(pickle.dumps(made))
    assert type(again) is type(made)
    assert again.to_dict() == made.to_dict()
    assert str(again) == str(made)


@pytest.mark.parametrize("name", SHOWN)
def test_text_and_html(name):
    made = EVERY[name]()
    text = str(made)
    assert text.strip()
    assert max(map(len, text.splitlines())) <= 80
    assert len(repr(made).splitlines()) == 1
    tags: list[str] = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag, attrs):
            tags.append(tag)

        def handle_endtag(self, tag):
            assert tags.pop() == tag

    Reader().feed(made._repr_html_())
    assert tags == []
    sentences, fine = made.answer()
    assert all(isinstance(sentence, str) and sentence for sentence in sentences)
    assert isinstance(fine, bool)


@pytest.mark.parametrize("name", DRAWN)
def test_the_picture_is_a_control_plot(name):
    drawn = EVERY[name]().plot()
    assert isinstance(drawn, ct.ControlPlot)
    assert drawn.figure.axes
    plt.close(drawn.figure)


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("name", SHOWN)
def test_the_report_gives_the_answer_first(name, tmp_path):
    made = EVERY[name]()
    folder = name == "Survey"
    page = made.report(tmp_path / ("pages" if folder else "page.html")).read_text(encoding="utf-8")
    heading = re.search(r"<h1>(.+?)</h1>", page)
    answer = re.search(r'aria-label="The answer"><p>(.+?)</p>', page)
    assert heading is not None
    assert answer is not None
    assert page.index(answer[0]) < page.index("<h2>")
