"""Named streams: the same key gives the same numbers, any difference in it others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from qrlsuite.seeding import Streams, pack, unpack

KEYS = st.tuples(st.text(), st.integers(0, 10**9), st.text(), st.integers(0, 10**9))


@given(KEYS, KEYS)
def test_same_key_same_numbers_other_key_others(one: tuple[Any, ...], other: tuple[Any, ...]) -> None:
    first = [Streams(task, seed).numpy(name, index).random() for task, seed, name, index in (one, one, other)]
    assert first[0] == first[1]
    assert (first[0] == first[2]) == (one == other)


def test_the_numbers_never_change() -> None:
    """Entries made by different versions must face the same episodes: the streams are part of the format."""
    assert Streams("t", 0).numpy("validation", 1).integers(1000, size=4).tolist() == [490, 212, 220, 384]


def test_torch_streams() -> None:
    one, two = Streams("t", 0).torch("init"), Streams("t", 0).torch("init")
    assert torch.equal(torch.rand(3, generator=one), torch.rand(3, generator=two))


def test_packed_generators_continue_where_they_stood() -> None:
    generators = [Streams("t", seed).numpy("x") for seed in range(3)]
    for generator in generators:
        generator.random(5)
        generator.integers(3, dtype=np.uint32)  # leaves half a word in the buffer
    copies = unpack(pack(generators))
    for generator, copy in zip(generators, copies):
        assert generator.random(9).tolist() == copy.random(9).tolist()
        assert (
            generator.integers(9, size=3, dtype=np.uint32).tolist()
            == copy.integers(9, size=3, dtype=np.uint32).tolist()
        )


def test_states_of_another_shape() -> None:
    with pytest.raises(ValueError, match=r"expected \(n, 13\)"):
        unpack(np.zeros((2, 5), np.uint64))
