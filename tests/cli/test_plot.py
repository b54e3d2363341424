"""`plot` and `compare --rule` as a user meets them, on learning curves that are simply written down."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from qrlsuite import registry, specs
from qrlsuite.errors import OptionError, PluginError
from qrlsuite.leaderboard import pictures
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.specs import EnvironmentSpec, PictureSpec
from tests.commands import say
from tests.conftest import TINY
from tests.leaderboard.test_pictures import learner, noisy


@pytest.fixture
def entries(monkeypatch: pytest.MonkeyPatch) -> list[EntryResults]:
    """Three entries in place of a results folder."""
    found = [learner("ddqn mlp width=16", 40), learner("ddqn mlp width=64", 10), noisy("ddqn vqc qubits=6")]

    def read(selection: collect.Selection, name: str) -> list[EntryResults]:
        return [next(entry for entry in found if name in entry.label)]

    monkeypatch.setattr(collect, "collect", lambda selection: (found, []))
    monkeypatch.setattr(collect, "read_copies", read)
    return found


def call(*words: str) -> str:
    done = say(*words)
    assert done.exit_code == 0, done.output
    return done.output


def test_help_lists_every_kind_of_the_suite_and_of_environments() -> None:
    output = call("plot", "--help")
    for name in (*pictures.KINDS, "trajectories", "field"):
        assert f"  {name} " in output


def test_curves_have_their_legend_beside_or_below_them() -> None:
    figure = pictures.draw("curves", [noisy(f"ddqn mlp width={width}") for width in range(6)])
    assert len(figure.axes[0].collections) == 0, "percentiles would hide each other"
    few = pictures.draw("curves", [noisy(f"ddqn mlp width={width}") for width in range(5)])
    assert len(few.axes[0].collections) == 5
    for each in (figure, few):
        each.draw_without_rendering()
        (legend,) = each.legends
        assert not legend.get_window_extent().overlaps(each.axes[0].get_window_extent())


@pytest.mark.parametrize("kind", ["curves", "surface", "bars", "tiers"])
def test_pictures_of_entries(kind: str, entries: list[EntryResults], tmp_path: Path) -> None:
    out = tmp_path / "p.svg"
    content = json.loads(call("plot", kind, "--out", str(out), "--json"))
    assert content["seeds"] == {entry.name: 30 for entry in entries}
    assert out.read_text().startswith("<?xml")
    words = ("--entry", "width=64", "--entry", "qubits=6", "--out", str(out), "--json")
    assert list(json.loads(call("plot", kind, *words))["seeds"]) == ["ddqn mlp width=64", "ddqn vqc qubits=6"]


def test_pictures_of_an_environment(tmp_path: Path) -> None:
    for kind, setting in (
        ("trajectories", "environment.degree=5"),
        ("field", "show=beam"),
        ("field", "resolution=40"),
    ):
        out = tmp_path / f"{kind}.png"
        call("plot", kind, "--task", "beam6g", setting, "--out", str(out))
        assert out.read_bytes().startswith(b"\x89PNG")


def test_a_picture_of_a_task_file_is_named_after_the_task(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.toml").write_text(TINY)
    call("plot", "field", "--task", str(tmp_path / "own.toml"))
    assert (tmp_path / "tiny-field.png").exists()


def test_a_third_partys_environment_may_draw_and_is_checked(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    known = registry.load().entries[specs.EnvironmentSpec]
    spec = known["beam6g"].spec
    assert isinstance(spec, EnvironmentSpec)
    options = "qrlsuite.plugins.environments.beam6g.pictures:FieldOptions"
    theirs = PictureSpec("map", "their map", "tests.cli.test_plot:not_a_figure", options)
    monkeypatch.setitem(known, "beam6g", replace(known["beam6g"], spec=replace(spec, pictures=(theirs,))))
    assert "their map (tasks of beam6g)" in call("plot", "--help")
    with pytest.raises(PluginError, match="returned str, not a matplotlib"):
        call("plot", "map", "--task", "beam6g", "--out", str(tmp_path / "m.png"))


def not_a_figure(worlds: object, options: object) -> str:
    return "no figure"


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("epsilon=[0.1]", "did you mean 'epsilons'"),
        ("environment.degree=4", "shows what was trained"),
        ("model.width=4", "write width=... for the picture"),
    ],
)
def test_settings_that_a_picture_has_not(setting: str, message: str, entries: list[EntryResults]) -> None:
    with pytest.raises(OptionError, match=message):
        call("plot", "bars", setting)


def test_settings_are_listed() -> None:
    assert "elevation = 22" in call("show", "picture", "surface")
    assert "degrees" in call("show", "trajectories")


def test_compare_begins_with_the_verdict_and_fits_eighty_columns(entries: list[EntryResults]) -> None:
    output = call("compare", "width=64", "width=16")
    assert all(len(line) <= 80 for line in output.splitlines())
    said = " ".join(output.split())
    assert said.startswith(
        "mlp width=64 needs 74% fewer steps than mlp width=16 (74% to 74%, 30 seeds each, p < .0001)"
    )
    assert "); final score 0.950 against 0.950, p = 1" in said
    assert said.endswith("settings: default, not tuned")
    assert "cell" not in output
    paper = " ".join(call("compare", "width=64", "width=16", "--rule", "paper").split())
    assert (
        "by the paper's rule, cell by cell, 30 seeds each: outperforms: significantly fewer samples in 49 of 49 cells, "
        "significantly more in none"
    ) in paper


def test_compare_shows_cells_by_the_rule_that_is_named(entries: list[EntryResults]) -> None:
    output = call("compare", "width=64", "width=16", "--rule", "times")
    assert all(len(line) <= 80 for line in output.splitlines())
    assert "by rule 'times', cell by cell, 30 seeds each: " in " ".join(output.split())
    assert output.strip().endswith("+ significantly fewer samples")


def test_rules_are_listed_shown_and_named_by_the_board(entries: list[EntryResults]) -> None:
    assert "steps" in call("list", "rules")
    assert "promises: mean steps of one pair" in call("show", "steps")
    assert "rule 'times': all tolerances" in call("leaderboard", "--rule", "times")
    assert json.loads(call("leaderboard", "--format", "json"))["rule"] == "intervals"
