"""Random numbers by name: one seed, and for each thing that it decides a stream of its own.

A stream is `numpy.random.SeedSequence` with the seed as entropy and the numbers of the names as its spawn
key. Streams do not depend on each other: what draws more from one changes nothing in another."""

from __future__ import annotations

import numpy as np

# what a seed decides; the numbers stay, so that the same seed goes on giving the same
STREAMS = {
    "friction": 1,  # of an episode of an evaluation
    "mass": 2,
    "feed": 0xFEED,  # where the pieces lie
    "errors": 0x0FF,  # by how much they really lie elsewhere than they are perceived
    "look": 3,  # the same of a later look, by its number
    "motion": 4,  # of a program, by its number
    "attempt": 5,  # at one motion, by its number
    "onwards": 6,  # of an arm that does not go home, by the number of its segment
    "around": 7,  # what the other arm does meanwhile, by the number of the segment
    "earlier": 8,  # a fetch that comes earlier, by the number of its segment
    "again": 9,  # a motion that is made anew from measured joints, by the number of its segment
    "recovery": 10,  # a program from a state as found, by how many there were before
}


def sequence(seed: int, name: str, *numbers: int) -> np.random.SeedSequence:
    """The sequence of one of STREAMS, and of numbers within it."""
    return np.random.SeedSequence(seed, spawn_key=(STREAMS[name], *numbers))


def stream(seed: int, name: str, *numbers: int) -> np.random.Generator:
    """A generator for one of STREAMS, and for numbers within it."""
    return np.random.default_rng(sequence(seed, name, *numbers))


def derived(seed: int, name: str, *numbers: int) -> int:
    """A seed for one of STREAMS, and for numbers within it: from 1 to 2^31 - 1, as libraries take them."""
    word = int(sequence(seed, name, *numbers).generate_state(1)[0])
    return 1 + word % (2**31 - 2)
