"""The suite from Python: training and playing as the commands do, from a program or a notebook."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from qrlsuite import api
from qrlsuite.engine.display import Bar
from qrlsuite.engine.where import Where
from qrlsuite.errors import OptionError, QrlSuiteError, UnknownNameError
from qrlsuite.results.seeds import read_seeds
from qrlsuite.studies.runner import Overview
from tests.commands import answer
from tests.commands import qrlsuite as command
from tests.conftest import results

OPTIONS = {"width": 4, "model.depth": 1}

STUDY = """
format_version = 1
name = "two"
summary = "Two widths"
[[entries]]
name = "mlp"
task = "{task}"
model = "mlp"
options = {{ depth = 1 }}
grid = {{ width = [4, 8] }}
[[pictures]]
name = "curves"
kind = "curves"
"""

pytestmark = pytest.mark.usefixtures("forked_workers")


def quiet(task: str, runs: Path, **more: Any) -> Any:
    return api.train(task, "mlp", options=OPTIONS, workers=1, runs=runs, progress=False, **more)


def test_training_and_resuming_give_the_bytes_of_the_command_line(
    tiny_task: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    first = quiet(tiny_task, tmp_path / "python", seeds=2, epochs=1)
    assert first.curves.shape == (2, 1)
    entry = quiet(tiny_task, tmp_path / "python", seeds=[0, 2, 1], epochs=2)
    of_epochs = api.table("epochs", runs=tmp_path / "python")
    assert {"training.loss", "training.return"} <= {*of_epochs.column_names}
    assert of_epochs["training.loss"].null_count < of_epochs.num_rows == 6
    assert entry.curves.shape == (3, 2)
    assert entry.seeds == (0, 1, 2)
    assert capfd.readouterr() == ("", ""), "quiet"
    words = ["run", "--task", tiny_task, "--model", "mlp", "--set", "width=4", "--set", "depth=1"]
    command(*words, "--seeds", "3", "--epochs", "2", "--workers", "1", "--runs", str(tmp_path / "command"))
    other = tmp_path / "command" / "tiny" / entry.name
    for seed in range(3):
        assert results(entry.folder, seed) == results(other, seed)


def test_progress_is_lines_where_there_is_no_terminal(
    tiny_task: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    api.train(tiny_task, "mlp", options=OPTIONS, seeds=1, epochs=1, workers=1, runs=tmp_path)
    out, shown = capfd.readouterr()
    assert out == ""
    assert "1 seed to epoch 1, 1 process. Ctrl-C saves; the same call continues." in shown
    assert "next:" not in shown


def test_training_that_is_stopped_before_an_epoch_gives_no_entry(tiny_task: str, tmp_path: Path) -> None:
    assert quiet(tiny_task, tmp_path, seeds=1, budget="0.0001s") is None
    assert quiet(tiny_task, tmp_path, seeds=1, epochs=1).curves.shape == (1, 1)


def test_evaluating(tiny_task: str, tmp_path: Path) -> None:
    entry = quiet(tiny_task, tmp_path, seeds=2, epochs=1)
    found = api.evaluate(entry.name, best=2, episodes=3, runs=tmp_path, progress=False)
    assert found.policies[0].name == entry.label
    assert found.policies[0].returns.shape == (2, 3)
    assert {"optimal", "random"} <= {policy.name for policy in found.policies}
    assert found.figure().axes
    shown = Console(width=130, file=sys.stderr)
    with shown.capture() as captured:
        shown.print(found)
    assert "3 fresh episodes of each policy" in captured.get()
    assert f"<td style='text-align:left'>{entry.label}</td>" in found._repr_html_()
    words = ["evaluate", entry.name, "--best", "2", "--episodes", "3", "--runs", str(tmp_path)]
    assert {**found.as_dict(), "picture": None} == answer(*words)


def test_tuning(tiny_task: str, tmp_path: Path) -> None:
    given: dict[str, Any] = {"seeds": 1, "epochs": 1, "workers": 1, "runs": tmp_path, "progress": False}
    (found,) = api.tune(tiny_task, "mlp width=4 model.depth=1", vary={"lr": (1e-2, 1e-3)}, **given)
    assert len(found.trials) == 2
    assert found.request.seeds == (1_000_000,)
    assert found.written is not None
    assert "the best of 2 trials" in found._repr_html_()
    entry = quiet(tiny_task, tmp_path, preset=str(found.written), seeds=1, epochs=1)
    assert entry.options["algorithm"]["lr"] == found.best.point["algorithm.lr"]


def test_running_a_study(tiny_task: str, tmp_path: Path) -> None:
    path = tmp_path / "two.toml"
    path.write_text(STUDY.format(task=tiny_task))
    given: dict[str, Any] = {
        "seeds": 2,
        "epochs": 1,
        "workers": 1,
        "runs": tmp_path / "runs",
        "progress": False,
    }
    done = api.run_study(str(path), **given)
    assert done.as_dict()["core_hours_left"] == 0
    assert "everything is there" in done._repr_html_()
    assert api.plot("curves", study=str(path), runs=tmp_path / "runs").axes
    only = api.run_study(str(path), only="width=8", **given)
    assert isinstance(only, Overview)
    assert [work.entry.label for work in only.works] == ["ddqn mlp width=8 depth=1"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"options": {"widht": 4}}, "option widht: no option of that name; did you mean 'width'"),
        ({"options": {"model.widht": 4}}, "did you mean 'width'"),
        ({"options": {3: 4}}, "options 3: write names"),
        ({"seeds": 0}, "at least one seed"),
        ({"seeds": -1}, "seeds -1: give a number"),
        ({"seeds": [0, 1.5]}, "seeds 1.5: give a number"),
        ({"seeds": True}, "seeds True: give a number"),
        ({"epochs": 0}, "epochs = 0: give a whole number, 1 or more"),
        ({"workers": 0}, "workers = 0"),
        ({"track": "tensorbord"}, "did you mean 'tensorboard'"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(
    arguments: dict[str, Any], message: str, tmp_path: Path
) -> None:
    given: dict[str, Any] = {"task": "beam6g", "model": "mlp", "runs": tmp_path / "runs", **arguments}
    with pytest.raises(QrlSuiteError, match=message.replace("(", r"\(")):
        api.train(given.pop("task"), given.pop("model"), **given)
    assert not (tmp_path / "runs").exists()


def test_bad_input_of_the_others(tiny_task: str, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="at least one entry"):
        api.evaluate([], runs=tmp_path)
    with pytest.raises(OptionError, match="best = 0"):
        api.evaluate("mlp", best=0, runs=tmp_path)
    with pytest.raises(OptionError, match="tuning uses seeds from 1000000 up"):
        api.tune(tiny_task, "mlp", vary={"lr": [1e-3]}, seeds=[0, 1], runs=tmp_path)
    with pytest.raises(OptionError, match=r"ending in \.toml"):
        api.tune(tiny_task, "mlp", vary={"lr": [1e-3]}, out="best.txt", runs=tmp_path)
    with pytest.raises(UnknownNameError, match="did you mean 'fig6'"):
        api.run_study("fig66", runs=tmp_path)
    with pytest.raises(OptionError, match="--budget 0h"):
        api.run_study("fig6", budget="0h", runs=tmp_path)
    with pytest.raises(OptionError, match="an engine that is built already"):
        api.train(tiny_task, "mlp", engine=Where.create(), workers=2, runs=tmp_path)
    assert list(tmp_path.iterdir()) == [Path(tiny_task)]


def test_seeds_in_every_form() -> None:
    assert read_seeds(3) == read_seeds("3") == read_seeds("0:3") == read_seeds({2, 0, 1}) == [0, 1, 2]
    assert read_seeds(range(5, 7)) == [5, 6]
    assert read_seeds(iter([4])) == [4]
    with pytest.raises(OptionError, match="none twice"):
        read_seeds([1, 1])


def test_a_bar_is_shown_on_a_terminal_only() -> None:
    hidden = Bar(Console(force_terminal=False))
    hidden.start(10, "training")
    assert not hidden.shown
    shown = Bar(Console(force_terminal=True, file=sys.stderr))
    shown.start(10, "training")
    assert shown.shown
    shown.update(5, "training", "half")
    shown.stop()
    assert not shown.shown


def test_a_notebook_s_bar_is_one_output_that_is_emptied_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a line printed in its place would leave stays in the notebook."""
    outputs: list[dict[str, str]] = []
    cell = SimpleNamespace(update=lambda data, raw: outputs.append(data))
    module = SimpleNamespace(display=lambda data, raw, display_id: outputs.append(data) or cell)
    monkeypatch.setitem(sys.modules, "IPython.display", module)
    bar = Bar(Console(force_jupyter=True))
    bar.start(10, "training")
    bar.update(5, "training", "6 s left")
    bar.stop()
    assert [data["text/plain"] for data in outputs] == ["training  0%  ", "training  50%  6 s left", ""]


def test_completion_offers_the_functions_alone() -> None:
    assert dir(api) == sorted(api.__all__)
