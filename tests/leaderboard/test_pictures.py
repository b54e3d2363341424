"""Pictures: they show the numbers that they should, say on how many seeds these rest, and survive any name."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from qrlsuite import options, specs
from qrlsuite.errors import OptionError, UnknownNameError
from qrlsuite.experiment import task as tasks
from qrlsuite.leaderboard import pictures
from qrlsuite.leaderboard.pictures import cells, histogram
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.statistics import Grid
from tests.leaderboard import boards


def learner(
    label: str = "ddqn mlp width=16",
    first_good: int = 10,
    seeds: int = 30,
    epochs: int = 100,
    quantum: int = 0,
    task: str = "beam6g",
    model_options: dict[str, Any] | None = None,
    environment_options: dict[str, Any] | None = None,
) -> EntryResults:
    """All runs reach .95 after the same epoch and stay: S_hat is that epoch in every cell, without spread."""
    curves = np.zeros((seeds, epochs))
    curves[:, first_good:] = 0.95
    identity = {
        "model": label.split()[1], "model_options": model_options or {},
        "task": {"environment_options": environment_options or {}},
    }  # fmt: skip
    made = boards.entry(label, seeds, epochs, quantum=quantum)
    return boards.changed(made, task_name=task, task_hash=task, curves=curves, identity=identity)


def noisy(label: str, seeds: int = 30, level: float = 0.9) -> EntryResults:
    generator = np.random.default_rng(len(label))
    pace = generator.lognormal(2.5, 0.4, (seeds, 1))
    curves = level - level * np.exp(-np.arange(1, 101) / pace) + 0.03 * generator.normal(size=(seeds, 100))
    return boards.changed(learner(label, seeds=seeds), curves=np.clip(curves, 0, 1))


def texts(figure: Figure) -> str:
    """Everything that is written in a picture."""
    found: list[str] = [text.get_text() for text in figure.findobj(lambda a: hasattr(a, "get_text"))]  # type: ignore[attr-defined]
    return "\n".join(found)


def bars(axes: Axes) -> list[Rectangle]:
    return [patch for patch in axes.patches if isinstance(patch, Rectangle) and patch.get_height() > 0]


ENTRIES: Sequence[EntryResults] = (
    learner("ddqn mlp width=16", 40, model_options={"width": 16}),
    learner("ddqn mlp width=64", 10, model_options={"width": 64}),
)


def test_kinds_have_a_line_settings_and_a_drawing_function() -> None:
    for picture in pictures.KINDS.values():
        assert len(picture.summary) <= 63, "a line of 80 characters in `qrlsuite plot --help`"
        assert callable(specs.resolve(f"{picture.module}:draw"))
        assert all(row["description"] for row in options.describe(specs.resolve(picture.options)))


@pytest.mark.parametrize("kind", [name for name, kind in pictures.KINDS.items() if kind.data == "entries"])
def test_any_name_can_be_drawn_and_seeds_are_stated(kind: str) -> None:
    names = ["ddqn <b>$x^$ 50\\% & \ud800\x00\u202e", "ddqn mlp " + "long " * 40]
    widths = ({"model": "mlp", "model_options": {"width": k + 1}} for k in range(2))
    entries = [boards.changed(noisy(name), identity=width) for name, width in zip(names, widths)]
    figure = pictures.draw(kind, entries)
    written = texts(figure)
    assert "30 seeds*" in written or "30 of 100 seeds" in written
    assert "provisional" in written
    assert pictures.encode(figure, "png").startswith(b"\x89PNG")
    encoded = pictures.encode(figure, "svg")
    assert encoded.startswith(b"<?xml")
    assert b"<b>" not in encoded


def test_bars_have_the_height_of_s_hat_and_fade_at_the_cap() -> None:
    assert "provisional" not in texts(pictures.draw("bars", [learner(seeds=100)]))
    never = learner("ddqn mlp width=8", 100)
    figure = pictures.draw("bars", [*ENTRIES, never], epsilons=[0.2], deltas=[0.5])
    first, second, third = bars(figure.axes[0])
    assert [patch.get_height() for patch in (first, second, third)] == [80_000, 20_000, 200_000]
    assert [patch.get_alpha() for patch in (first, second, third)] == [1, 1, 0.3]
    assert "≥" in texts(figure)
    assert "faded" in texts(figure)


def test_bars_of_a_cell_stand_side_by_side_around_its_label() -> None:
    entries = [*ENTRIES, learner("ddqn mlp width=8", 20)]
    axes = pictures.draw("bars", entries, epsilons=[0.2, 0.3], deltas=[0.5]).axes[0]
    for cell, tick in enumerate(axes.get_xticks()):
        of_cell = bars(axes)[cell::2]  # they are drawn entry by entry
        sides = [(bar.get_x(), bar.get_x() + bar.get_width()) for bar in of_cell]
        assert np.mean(sides) == pytest.approx(tick)
        assert all(right < left for (_, right), (left, _) in itertools.pairwise(sides)), "none covers another"
        assert tick - 0.5 < sides[0][0]
        assert sides[-1][1] < tick + 0.5


def test_surface_writes_s_hat_in_thousands() -> None:
    figure = pictures.draw("surface", ENTRIES, epsilons=[0.2, 0.3], deltas=[0.5])
    written = texts(figure).split("\n")
    assert written.count("80") == 2
    assert written.count("20") == 2
    assert "387 parameters, 30 seeds*" in texts(figure)


def test_a_picture_is_cut_to_the_shortest_entry_and_says_so() -> None:
    figure = pictures.draw("surface", [ENTRIES[0], learner("ddqn mlp width=8", 5, epochs=20)])
    assert "all cut to 40k steps, the length of ddqn mlp width=8" in " ".join(texts(figure).split())
    with pytest.raises(OptionError, match="'ddqn mlp width=8' ends at 40000 steps"):
        pictures.draw("surface", [ENTRIES[0], learner("ddqn mlp width=8", 5, epochs=20)], horizon=100_000)


def test_scaling_orders_by_size_with_a_panel_per_model() -> None:
    quantum = [
        learner(f"ddqn vqc qubits={n}", first, quantum=n, model_options={"qubits": n, "layers": 4})
        for n, first in ((10, 20), (6, 30), (8, 25))
    ]
    figure = pictures.draw("scaling", [*ENTRIES, *quantum])
    classical, circuits = figure.axes
    assert (classical.get_xlabel(), circuits.get_xlabel()) == ("width", "qubits")
    line = circuits.get_lines()[0]
    assert list(line.get_xdata()) == [6, 8, 10]
    assert list(line.get_ydata()) == [60_000, 50_000, 40_000]
    assert "387 + 8" in texts(figure)


def test_scaling_bars_reach_from_the_5th_to_the_95th_percentile() -> None:
    entries = [noisy(f"ddqn mlp width={n}", level=level) for n, level in ((16, 0.9), (64, 0.95))]
    entries = [boards.changed(e, identity={"model_options": {"width": n}}) for e, n in zip(entries, (16, 64))]
    grid = Grid.relative([0.2], [0.5])
    axes = pictures.draw("scaling", entries, epsilons=[0.2], deltas=[0.5]).axes[0]
    for entry, drawn in zip(entries, axes.containers, strict=True):
        [(_, low), (_, high)] = drawn.lines[2][0].get_segments()[0]
        measured = cells.measure(entry, grid, 200_000)
        expected, point = measured.intervals[0, 0].tolist(), measured.points[0, 0]
        assert [low, high] == pytest.approx(expected)
        assert high - point != pytest.approx(point - low), "else swapped ends would not show"


def test_scaling_draws_depth_for_each_width_but_no_line_of_chance_pairs() -> None:
    entries = [
        learner(f"ddqn mlp width={w} depth={d}", w // 4, model_options={"width": w, "depth": d})
        for w, d in [(16, 2), (32, 2), (64, 2), (32, 1), (32, 3), (64, 1), (64, 3)]
    ]
    width, depth = pictures.draw("scaling", entries).axes
    assert [line.get_label() for line in labeled(width)] == ["mlp"]
    assert {line.get_label() for line in labeled(depth)} == {"mlp width=32", "mlp width=64"}


def labeled(axes: Axes) -> list[Any]:
    return [line for line in axes.get_lines() if not str(line.get_label()).startswith("_")]


def test_scaling_over_tasks_averages_instances() -> None:
    entries = [
        learner(f"ddqn mlp {n}-{k}", first, task=f"a{n}-{k}", environment_options={"antennas": [[0]] * n})
        for n, k, first in ((2, 0, 10), (2, 1, 20), (3, 0, 30), (3, 1, 50))
    ]
    figure = pictures.draw("scaling", entries, by="environment.antennas")
    line = figure.axes[0].get_lines()[0]
    assert (list(line.get_xdata()), list(line.get_ydata())) == ([2, 3], [30_000, 80_000])
    assert "mean over instances" in texts(figure)
    with pytest.raises(OptionError, match=r"by = 'environment\.antenas'.*did you mean 'environment\.ant"):
        pictures.draw("scaling", entries, by="environment.antenas")


def test_scaling_draws_lines_that_are_not_complete_yet_and_names_what_it_leaves_out() -> None:
    entries = [
        learner(f"ddqn {model} {n}", 10, task=f"a{n}", environment_options={"antennas": [[0]] * n})
        for model, sizes in (("mlp", (2, 3, 4)), ("vqc", (2, 3)), ("odd", (2,)))
        for n in sizes
    ]
    figure = pictures.draw("scaling", entries, by="environment.antennas")
    lines = [(line.get_label(), len(line.get_xdata())) for line in labeled(figure.axes[0])]
    assert lines == [("mlp", 3), ("vqc", 2)]
    assert "not shown, too few of a kind for a line: ddqn odd 2" in texts(figure).replace("\n", " ")


def test_tiers_say_in_how_many_cells() -> None:
    few = learner("ddqn mlp width=8", 10, seeds=10)
    figure = pictures.draw("tiers", [*ENTRIES, few])
    written = texts(figure)
    assert "49" in written.split("\n"), "width=64 needs fewer samples in all cells"
    assert "tier 1" in written
    assert "undecided: fewer than 20 seeds" in written


def test_histogram_says_means_and_numbers_of_episodes() -> None:
    figure = histogram.draw({"optimal": np.full(4, 2.0), "mlp": np.array([[1.0, 2.0], [3.0, 2.0]])})
    assert "optimal   mean 2   (4 episodes)" in texts(figure)
    assert "mlp   mean 2   (2 x 2 episodes)" in texts(figure)
    with pytest.raises(OptionError, match="policy 'mlp' has a value that is not finite"):
        histogram.draw({"mlp": [1.0, float("nan")]})
    with pytest.raises(OptionError, match="at least one policy"):
        histogram.draw({})


def test_curves_show_single_runs_of_few() -> None:
    others = 3  # lines at the scores of policies
    few = pictures.draw("curves", [learner(seeds=3)])
    assert len(few.axes[0].get_lines()) == 4 + others
    many = pictures.draw("curves", [learner(seeds=50)])
    assert len(many.axes[0].get_lines()) == 1 + others
    assert not [c for c in many.axes[0].collections if isinstance(c, PathCollection)]


def test_curves_have_the_scores_of_policies_whose_names_do_not_lie_on_each_other() -> None:
    [axes] = pictures.draw("curves", [learner(seeds=50)]).axes
    stated = tasks.load("beam6g").file.ranking.policies
    assert {line.get_ydata()[0] for line in axes.get_lines() if line.get_linestyle() == ":"} == set(
        stated.values()
    )
    places = {text.get_text(): text.get_position()[1] for text in axes.texts}
    assert places["random"] == pytest.approx(stated["random"])
    assert places["optimal"] - places["nearest antenna"] >= 0.04 - 1e-9


def test_a_curve_of_one_epoch_can_be_seen() -> None:
    both = [learner(seeds=3), boards.changed(learner("ddqn mlp width=8"), curves=learner().curves[:, :1])]
    lines = labeled(pictures.draw("curves", both).axes[0])
    markers = [
        line.get_marker() for each in both for line in lines if line.get_label().startswith(each.label)
    ]
    assert markers == ["None", "o"]


@pytest.mark.parametrize("kind", ["curves", "surface", "bars", "tiers"])
def test_entries_of_two_tasks_are_not_mixed(kind: str) -> None:
    with pytest.raises(OptionError, match="shows one task"):
        pictures.draw(kind, [learner(), learner("ddqn mlp width=8", task="other")])
    with pytest.raises(OptionError, match="at least one entry"):
        pictures.draw(kind, [])


def test_unknown_kinds_and_settings_get_the_nearest_match() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'surface'"):
        pictures.draw("surfce", ENTRIES)
    with pytest.raises(OptionError, match="no option 'styl'; did you mean 'style'"):
        pictures.draw("surface", ENTRIES, styl="3d")


def test_no_global_state_of_matplotlib_is_touched() -> None:
    program = (
        "import sys; from qrlsuite.leaderboard import pictures; assert pictures.KINDS; "
        "assert 'matplotlib' not in sys.modules; "
        "import matplotlib; now = lambda: {k: matplotlib.rcParams[k] for k in matplotlib.rcParams "
        "if k != 'backend'}; before = now(); "  # asking for the backend imports pyplot
        "from tests.leaderboard.test_pictures import ENTRIES, pictures; "
        "[pictures.draw(k, ENTRIES) for k in ('curves', 'bars', 'surface')]; "
        "assert 'matplotlib.pyplot' not in sys.modules; assert before == now()"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=Path(__file__).parents[2])


def test_legends_name_the_ansatz_and_pictures_of_many_can_be_read() -> None:
    entries = [learner(f"ddqn vqc-native qubits={n}", model_options={"ansatz": "iqp"}) for n in range(12)]
    for kind in ("curves", "bars", "surface", "tiers"):
        figure = pictures.draw(kind, entries)
        assert "vqc-native qubits=11 ansatz=iqp" in texts(figure)
    assert pictures.draw("bars", entries).get_figwidth() <= 12
    named = learner("ddqn vqc-native qubits=4 ansatz=cz", model_options={"ansatz": "cz"})
    assert named.legend == named.label


def test_an_entry_keeps_its_color_where_others_are_left_out() -> None:
    entries = [replace(entry, color=place) for place, entry in enumerate(ENTRIES)]
    both, one = pictures.draw("curves", entries), pictures.draw("curves", entries[1:])
    assert both.axes[0].lines[-1].get_color() == one.axes[0].lines[-1].get_color()
    both, one = (bars(pictures.draw("bars", some).axes[0]) for some in (entries, entries[1:]))
    assert {bar.get_facecolor()[:3] for bar in one} <= {bar.get_facecolor()[:3] for bar in both[-6:]}
