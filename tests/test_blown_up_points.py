"""A trial point of a descent whose model is no number costs infinitely much; it does not end the descent."""

import numpy as np
from inner import ResponseEngine, Structure, as_physical, ordered_record

import rcorefine as rco

MODEL = rco.mass_spring_damper(1.0, 0.4, 100.0)
STRUCTURE = Structure(as_physical(MODEL), [rco.Effect("stiffness", "link1")])


def test_a_response_at_a_point_that_is_no_number_is_reported_as_blown_up():
    force = np.random.default_rng(0).standard_normal(2000)
    record = rco.Measurement(force, np.convolve(force, [0, 0.1, 0.05])[:2000], dt=0.05)
    engine = ResponseEngine(STRUCTURE, ordered_record(as_physical(MODEL), record.frequency_response()))
    sound, lost = (engine.run(np.array([value])) for value in (1.0, np.nan))
    assert (sound.blew_up, lost.blew_up) == (-1, 0)
    assert lost.outputs.shape == sound.outputs.shape
    assert lost.sensitivity.shape == sound.sensitivity.shape
