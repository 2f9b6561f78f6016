"""Samples of the stream one after the other: test, alarm, and the rows of the course."""

from __future__ import annotations

import math

import numpy as np

from ...systems.linear import Array
from ..gaps import Block
from .course import Course
from .sequential_test import Watch
from .standing import find_state, shares, standing
from .stream import Stream

__all__ = ["watch_block"]

_CHUNK = 2048  # samples at a time


def watch_block(stream: Stream, watch: Watch, course: Course, block: Block, position: int = 0) -> None:
    """Take the samples of a block from `position` on, and act on what the test says.

    Parameters
    ----------
    stream : Stream
        Observer, bank and windows.
    watch : Watch
        The alarm, or what goes before one.
    course : Course
        Gets a row where one is due.
    block : Block
        Samples.
    position : int, optional
        First sample to take.
    """
    total = len(block.inputs)
    while position < total:
        here = stream.n_samples
        until = min(here + total - position, here + _CHUNK, course.due(here))
        healthy = not watch.busy
        if not healthy:
            until = min(until, watch.next_event(here))
        if stream.find_at > here:
            until = min(until, stream.find_at)
        part = block.part(position, position + until - here)
        done, ratio = stream.advance(part.inputs, part.outputs, part.use, part.known, stop=healthy)
        position += done
        if healthy and ratio[-1] > 1.0:
            watch.ring(stream)
        elif not healthy and stream.n_samples >= watch.next_event(here):
            watch.attend(stream)
        if stream.n_samples == stream.find_at:
            find_state(stream)
        if stream.n_samples % course.stride == 0:
            course.add(stream.n_samples, _row(stream, watch))


def _row(stream: Stream, watch: Watch) -> Array:
    """Probabilities, statistic over its threshold, coefficient and its standard deviation."""
    ratio, gains = standing(stream)
    if watch.gains is None:
        p, value, std = shares(float(gains.max()), gains), math.nan, math.nan
    else:
        p, value, std = shares(watch.change(stream), watch.gains), watch.value, watch.std
    return np.concatenate([p, [ratio, value, std]])
