"""Tiers of boards small enough to draw."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from qrlsuite.errors import OptionError
from qrlsuite.statistics import Ranking, rank


def ranking(names: str, *wins: str, undecided: tuple[str, ...] = ()) -> Ranking:
    """Rank one-letter entries; `"ab"` in wins means that a outperforms b, in undecided that nobody knows."""
    index = {name: i for i, name in enumerate(names)}
    outperforms = np.zeros((len(names), len(names)), dtype=bool)
    decided = np.ones_like(outperforms)
    for pair in wins:
        outperforms[index[pair[0]], index[pair[1]]] = True
    for first, second in undecided:
        decided[index[first], index[second]] = decided[index[second], index[first]] = False
    return rank(list(names), outperforms, decided)


def tiers(result: Ranking) -> list[str]:
    return ["".join(entry.name for entry in tier) for tier in result.tiers]


def test_a_chain_has_a_tier_each() -> None:
    assert tiers(ranking("cba", "ab", "bc", "ac")) == ["a", "b", "c"]


def test_entries_that_nobody_outperforms_share_the_first_tier() -> None:
    assert tiers(ranking("abc")) == ["abc"]
    assert tiers(ranking("abc", "ab")) == ["ac", "b"]


def test_three_in_a_circle_share_a_tier() -> None:
    result = ranking("abcde", "ab", "bc", "ca", "da", "ce")
    assert tiers(result) == ["d", "cba", "e"]
    by_name = {entry.name: entry for entry in result.entries}
    assert by_name["a"].cycle == ("a", "b", "c")
    assert by_name["d"].cycle == ()
    assert by_name["c"].copeland == 1
    assert by_name["c"].outperforms == ("a", "e")
    assert by_name["c"].outperformed_by == ("b",)


def test_two_circles_and_a_bridge() -> None:
    assert tiers(ranking("abcdef", "ab", "bc", "ca", "de", "ef", "fd", "cd")) == ["cab", "efd"]


def test_the_longest_chain_decides() -> None:
    # d is outperformed by a directly, and through b and c
    assert tiers(ranking("abcd", "ab", "bc", "cd", "ad")) == ["a", "b", "c", "d"]
    assert tiers(ranking("abcde", "ae", "bc", "cd", "de")) == ["ab", "c", "d", "e"]


def test_copeland_orders_a_tier_then_names_do() -> None:
    result = ranking("dcba", "ac", "bc", "bd")
    assert tiers(result) == ["ba", "dc"]
    assert [entry.copeland for tier in result.tiers for entry in tier] == [2, 1, -1, -2]


def test_an_entry_without_a_decided_pair_stands_apart() -> None:
    result = ranking("abz", "ab", undecided=("az", "bz"))
    assert tiers(result) == ["a", "b"]
    assert [entry.name for entry in result.undecided] == ["z"]
    assert result.undecided[0].tier is None
    assert [entry.name for entry in result.entries] == ["a", "b", "z"]


def test_one_entry_or_none_cannot_be_ranked() -> None:
    assert [entry.name for entry in rank(["a"], [[False]], [[True]]).undecided] == ["a"]
    assert rank([], np.zeros((0, 0)), np.zeros((0, 0))).entries == ()


@pytest.mark.parametrize(
    ("names", "outperforms", "decided", "message"),
    [
        (["a", "a"], np.zeros((2, 2)), np.ones((2, 2)), "two entries are called 'a'"),
        (["a", "b"], np.zeros((2, 3)), np.ones((2, 2)), r"outperforms: expected shape \(2, 2\)"),
        (["a", "b"], np.zeros((2, 2)), np.ones(4), r"decided: expected shape \(2, 2\)"),
        (["a", "b"], np.zeros((2, 2)), [[1, 0], [1, 1]], "not symmetric"),
        (["a", "b"], [[1, 0], [0, 0]], np.ones((2, 2)), "'a' outperforms 'a': an entry cannot"),
        (["a", "b"], [[0, 1], [1, 0]], np.ones((2, 2)), "'a' outperforms 'b', but also the reverse"),
        (["a", "b"], [[0, 1], [0, 0]], np.zeros((2, 2)), "'a' outperforms 'b', but the pair is undecided"),
    ],
)
def test_a_relation_that_cannot_be_is_refused(
    names: list[str], outperforms: object, decided: object, message: str
) -> None:
    with pytest.raises(OptionError, match=message):
        rank(names, outperforms, decided)  # type: ignore[arg-type]


@given(
    st.integers(1, 9).flatmap(
        lambda size: hnp.arrays(np.int8, (size, size), elements=st.sampled_from([0, 0, 1]))
    )
)
def test_tiers_follow_the_definition(wins: np.ndarray) -> None:
    size = len(wins)
    beats = np.triu(wins, 1) > 0
    beats |= (np.tril(wins, -1) > 0) & ~beats.T
    names = [chr(ord("a") + i) for i in range(size)]
    result = rank(names, beats, np.ones((size, size)))
    if size == 1:
        assert result.tiers == ()
        return
    tier = {entry.name: entry.tier for entry in result.entries}

    def reachable(start: int) -> set[int]:
        seen, stack = {start}, [start]
        while stack:
            for other in np.flatnonzero(beats[stack.pop()]):
                if other not in seen:
                    seen.add(int(other))
                    stack.append(int(other))
        return seen

    reach = [reachable(i) for i in range(size)]

    def longest(index: int) -> int:
        circle = [other for other in range(size) if other in reach[index] and index in reach[other]]
        above = [a for a in range(size) if a not in circle and beats[a, circle].any()]
        return 1 + max((longest(a) for a in above), default=0)

    assert [tier[names[i]] for i in range(size)] == [longest(i) for i in range(size)]
    assert sorted(set(tier.values())) == list(range(1, len(result.tiers) + 1))


def test_a_tier_rests_on_the_narrowest_win_of_the_chain_above_it() -> None:
    names = ["a", "b", "c", "d"]
    cells = np.zeros((4, 4), dtype=int)
    cells[0, 1], cells[1, 2], cells[0, 2], cells[2, 3], cells[0, 3] = 1, 40, 49, 7, 30
    result = rank(names, cells > 0, np.ones((4, 4)), cells)
    assert [entry.rests_on for entry in result.entries] == [None, ("a", "b"), ("a", "b"), ("a", "b")]
    cells[0, 1] = 9
    result = rank(names, cells > 0, np.ones((4, 4)), cells)
    assert [entry.rests_on for entry in result.entries] == [None, ("a", "b"), ("a", "b"), ("c", "d")]


def test_of_two_chains_the_firmer_counts() -> None:
    cells = np.zeros((3, 3), dtype=int)
    cells[0, 2], cells[1, 2] = 1, 20
    assert rank(["a", "b", "c"], cells > 0, np.ones((3, 3)), cells).tiers[1][0].rests_on == ("b", "c")


def test_entries_that_reached_no_goal_are_not_ranked_among_each_other() -> None:
    # c is outperformed by b, d by a alone: without the mark d would stand a tier above c
    cells = np.zeros((4, 4), dtype=int)
    cells[0, 1], cells[0, 2], cells[1, 2], cells[0, 3] = 20, 20, 5, 5
    names, decided = ["a", "b", "c", "d"], np.ones((4, 4))
    assert tiers(rank(names, cells > 0, decided, cells)) == ["a", "bd", "c"]
    result = rank(names, cells > 0, decided, cells, [False, False, True, True])
    assert tiers(result) == ["a", "b"]
    apart = [(entry.name, entry.tier, entry.rests_on) for entry in result.not_reached]
    assert apart == [("c", None, None), ("d", None, None)]
    assert result.not_reached[0].outperformed_by == ("a", "b")
    assert [entry.name for entry in result.entries] == list(names)
    assert result.undecided == ()
