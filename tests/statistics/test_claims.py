"""Claims of studies with looks: their error where it is largest, and what each kind needs to hold."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from qrlsuite.errors import OptionError
from qrlsuite.statistics import Grid, LearningCurves, SequentialDesign, decide
from qrlsuite.statistics.planning import claim_chances
from qrlsuite.statistics.sequential import Claim, ClaimDecision, holm_claims, next_claim
from qrlsuite.studies import together
from qrlsuite.studies.state import State

BEATS = Claim("a", ("b", "c"))
AT_MOST = Claim("a", ("b", "c"), at_most=0.1)
FASTER = Claim("a", ("b", "c"), tasks=3)
STUDIES = 900


def planned(*claims: Claim, looks: tuple[int, ...] = (20, 30, 40)) -> SequentialDesign:
    return SequentialDesign(("a", "b", "c"), looks, rule="steps", claims=claims)


def played(design: SequentialDesign, means: tuple[int, int, int], spread: float = 0.2) -> list[ClaimDecision]:
    """Return the claim of a design in `STUDIES` studies, whose entries need normal numbers of steps."""
    generator = np.random.default_rng(5)
    drawn = [
        np.rint(generator.normal(mean, spread * mean, (STUDIES, design.looks[-1], 1))).astype(np.int64)
        for mean in means
    ]
    [claim] = design.claims
    claims = []
    for study in range(STUDIES):
        times, decided = {name: each[study] for name, each in zip("abc", drawn)}, ClaimDecision(claim)
        for look in range(len(design.looks)):
            decided = decided if decided.closed else next_claim(design, look, decided, times)
        claims.append(decided)
    return claims


def test_beating_all_errs_at_alpha_where_one_rival_is_equal() -> None:
    """The worst null: one rival as fast, the other far behind. Then Holm over three tasks keeps the error, too."""
    design = planned(FASTER)
    claims = played(design, (10_000, 10_000, 30_000))
    wrong = np.mean([claim.established is not None for claim in claims])
    assert 0.035 < wrong < 0.068, "all of alpha, and no more"
    families = [
        holm_claims([(design, claim) for claim in claims[at : at + 3]], 3) for at in range(0, STUDIES, 3)
    ]
    assert 0.02 < np.mean([any(family) for family in families]) < 0.085


def test_at_most_so_much_more_errs_at_alpha_where_all_need_just_that() -> None:
    wrong = np.mean([c.established is not None for c in played(planned(AT_MOST), (10_000, 11_000, 11_000))])
    assert 0.02 < wrong < 0.065


@pytest.mark.parametrize(("claim", "lead"), [(BEATS, 0.15), (AT_MOST, 0.0)])
def test_chances_of_claims_are_those_of_played_studies(claim: Claim, lead: float) -> None:
    design = planned(claim)
    other = round(10_000 / (1 - lead))
    at = [each.established for each in played(design, (10_000, other, other))]
    shares = [np.mean([each is not None and each <= look for each in at]) for look in design.looks]
    assert 0.1 < shares[0] < shares[-1] < 0.97
    assert claim_chances(design, claim, 0.2, lead) == pytest.approx(shares, abs=0.06)


def test_holm_goes_on_with_the_tasks_that_are_left() -> None:
    """At one look: p .01 holds at .05 / 3, then .02 at .05 / 2, then .04; alone, .02 and .04 do not."""
    design = planned(FASTER, looks=(40,))
    decided = [(design, ClaimDecision(FASTER, ((p, 0.001),), ((0, 0),), 40)) for p in (0.04, 0.01, 0.02)]
    assert holm_claims(decided, 3) == [True] * 3
    assert holm_claims(decided, 6) == [False] * 3, "of tasks whose studies are not given nothing is known"
    assert holm_claims(decided[::2], 3) == [False, False]


def test_claims_of_several_studies_are_one_claim_whatever_the_order_of_rivals() -> None:
    design = planned(FASTER, looks=(40,))

    def state(task: str, *rivals: str) -> State:
        decided = ClaimDecision(Claim("a", rivals), ((0.001, 0.001),), ((0, 0),), 40)
        study = SimpleNamespace(design=design, task=task)
        return cast("State", SimpleNamespace(study=study, decision=SimpleNamespace(claims=(decided,))))

    [(claim, tasks)] = together._claims([state("one", "b", "c"), state("two", "c", "b")])
    assert claim == "on at least one of 2 tasks a needs fewer steps than each of b, c"
    assert tasks == ("one", "two")
    assert not [*together._claims([state("one", "b", "c"), state("two", "b")])]


def test_an_open_claim_keeps_its_entries_and_all_rivals_are_beaten_at_one_look() -> None:
    def runs(count: int) -> dict[str, LearningCurves]:
        epochs = {"a": (9, 11), "b": (29, 31), "c": (9, 11)}
        late = np.arange(count) >= 20
        starts = {name: np.resize(each, count) for name, each in epochs.items()}
        starts["b"] = np.where(late, 1, starts["b"])  # behind at the first look, ahead by the last one
        starts["c"] = np.where(late, 39, starts["c"])
        return {
            name: LearningCurves((np.arange(40) >= each[:, None]).astype(float), 100, name)
            for name, each in starts.items()
        }

    grid = Grid.relative([0.1], [0.5])
    design = SequentialDesign(
        ("a", "b", "c"), (20, 200), pairs=(("a", "b"),), rule="steps", claims=(BEATS, AT_MOST)
    )
    first = decide(design, runs(20), grid)
    assert first.pairs[0].differs
    assert first.wanted == {"a": 200, "b": 200, "c": 200}, "the pair is closed, a claim is open"
    beats, at_most = first.claims
    assert (beats.p[0][0] < 1e-3, beats.p[0][1] > 0.01) == (True, True)
    assert beats.verdict.startswith("open after 20 seeds; leads above ")
    assert (at_most.established, at_most.closed) == (20, True), "c needs as many, whatever b needs"
    assert 0 < at_most.excluded < 0.1
    ended = decide(design, runs(200), grid)
    assert ended.finished
    assert ended.claims[0].p[1][1] < 1e-3 < ended.claims[0].p[1][0], "the other one, and not both at one look"
    assert ended.claims[0].verdict.startswith("not established after 200 seeds; ")
    assert ended.claims[1] == at_most


def test_that_it_beats_all_is_given_up_where_a_pair_says_the_reverse() -> None:
    slow, fast = np.resize((29, 31), 20), np.resize((9, 11), 20)
    runs = {
        name: LearningCurves((np.arange(40) >= each[:, None]).astype(float), 100, name)
        for name, each in {"a": slow, "b": slow, "c": fast}.items()
    }
    design = SequentialDesign(("a", "b", "c"), (20, 200), pairs=(("c", "a"),), rule="steps", claims=(BEATS,))
    decision = decide(design, runs, Grid.relative([0.1], [0.5]))
    assert decision.finished
    assert decision.claims[0].verdict.startswith("not established after 20 seeds; ")
    other = decide(replace(design, pairs=(("a", "b"),)), runs, Grid.relative([0.1], [0.5]))
    assert other.wanted == {"a": 200, "b": 200, "c": 200}, "no pair says it"


@pytest.mark.parametrize(
    ("claim", "rule", "message"),
    [
        (BEATS, "times", "claims are tested by rule 'steps', and the study has rule 'times'"),
        (Claim("a", ("z",)), "steps", "claims: 'z' is not one of the entries"),
        (Claim("a", ("a",)), "steps", r"claims: \['a', 'a'\]: a name is repeated"),
    ],
)
def test_bad_claims_are_named(claim: Claim, rule: str, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        SequentialDesign(("a", "b"), rule=rule, claims=(claim,))
