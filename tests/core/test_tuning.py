"""Tuning: spaces, samplers, what a trial is worth, and searches that end the same however often they were stopped."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qrlsuite.errors import FileError, OptionError, QrlSuiteError, StoreError, UnknownNameError
from qrlsuite.experiment import preset
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.experiment.task import RankingSection
from qrlsuite.leaderboard.shelf.published import PUBLISHED
from qrlsuite.options import parse_setting
from qrlsuite.results.store import EntryStore
from qrlsuite.tuning import objective, samplers, search, space

SETTINGS = (parse_setting("width=4"), parse_setting("depth=1"))
FIXED = tuple(
    parse_setting(word)
    for word in ("input_scale=1", "epsilon=.1", "buffer=2000", "batch=64", "target_steps=2000")
)
"""What else is tuned than the learning rate."""
RANKING = RankingSection.model_validate(
    {
        "epsilons": [0.5, 0.2],
        "deltas": [0.5, 1.0],
        "reference": {"epsilon": 0.2, "delta": 0.5},
        "horizons": [40],
    }
)


def varied(*words: str) -> tuple[Any, ...]:
    return tuple(space.parse_varied(word) for word in words)


def request(task: str, **changes: Any) -> search.Request:
    given: dict[str, Any] = {
        "settings": SETTINGS,
        "varied": varied("lr=1e-2,1e-3", "gamma=.9,.99"),
        "seeds": search.tuning_seeds("2"),
        "epochs": 1,
    }
    return search.Request(task, "mlp", **{**given, **changes})


class Trainer:
    """Trains in this process, and can be interrupted before a trial."""

    def __init__(self, folder: Path, stop_before: int | None = None) -> None:
        self.folder, self.stop_before, self.trained = folder, stop_before, 0

    def __call__(self, entries: Sequence[Entry], seeds: Sequence[int], epochs: int) -> list[EntryStore]:
        return [self.train(entry, seeds, epochs) for entry in entries]

    def train(self, entry: Entry, seeds: Sequence[int], epochs: int) -> EntryStore:
        from qrlsuite.engine.worker import train_group

        store = EntryStore.create(self.folder, entry)
        missing = sorted(set(seeds) - store.finished(seeds, epochs))
        if missing:
            if self.trained == self.stop_before:
                raise KeyboardInterrupt
            self.trained += 1
            train_group(store.path, missing, epochs)
        return store


def finish(what: search.Search, stop_before: int | None = None) -> Trainer:
    trainer = Trainer(what.runs, stop_before)
    while not what.over:
        what.step(trainer)
    return trainer


def without_hours(text: str) -> str:
    return "\n".join(line for line in text.splitlines() if not line.startswith("core_hours"))


def test_a_search_that_was_stopped_ends_with_the_same_preset(tiny_task: str, tmp_path: Path) -> None:
    wanted = request(tiny_task)
    straight = search.Search(wanted, tmp_path / "straight")
    finish(straight)
    assert [trial.number for trial in straight.trials] == [1, 2, 3, 4], "every combination"
    with pytest.raises(KeyboardInterrupt):
        finish(search.Search(wanted, tmp_path / "stopped"), stop_before=2)
    resumed = search.Search(wanted, tmp_path / "stopped")
    trainer = finish(resumed)
    distinct = len({trial.entry.hash for trial in straight.trials})
    assert trainer.trained == distinct - 2, "finished trials are not trained again"
    straight.write(straight.path)
    resumed.write(resumed.path)
    assert straight.path.name == resumed.path.name
    assert without_hours(straight.path.read_text()) == without_hours(resumed.path.read_text())
    assert resumed.preset().tuning is not None
    assert [(t.point, t.merit) for t in straight.trials] == [(t.point, t.merit) for t in resumed.trials]


def test_the_preset_is_the_best_trial_and_the_entry_says_so(tiny_task: str, tmp_path: Path) -> None:
    found = search.Search(request(tiny_task), tmp_path)
    finish(found)
    assert found.best is not None
    assert found.best.merit.order == min(trial.merit.order for trial in found.trials)
    path = tmp_path / "mine.toml"
    found.write(path)
    entry = resolve(tiny_task, "mlp", preset=str(path))
    assert entry.hash == found.best.entry.hash, "the options decide what the entry is"
    assert entry.tuning is not None
    assert (entry.tuning["trials"], entry.tuning["steps"]) == (4, 4 * 2 * 60)
    assert entry.tuning["changed"] == []
    assert not entry.tuning["on_protocol_seeds"]
    changed = resolve(tiny_task, "mlp", settings=[parse_setting("lr=.5")], preset=str(path))
    assert changed.tuning is not None
    assert changed.tuning["changed"] == ["algorithm.lr"]

    untuned = resolve(tiny_task, "mlp", settings=[*SETTINGS, *space.settings(found.best.point)])
    store = EntryStore.create(tmp_path / "runs", untuned)
    assert store.record().tuned is None
    EntryStore.create(tmp_path / "runs", entry)
    assert store.record().tuning.trials == 4, "an entry that was there before learns that it was tuned"
    assert store.entry().tuning == entry.tuning
    EntryStore.create(tmp_path / "runs", untuned)
    assert store.record().tuning.trials == 4, "and does not forget it"


def test_the_preset_names_the_gpu_that_trained_its_trials(tiny_task: str, tmp_path: Path) -> None:
    here = search.Search(request(tiny_task), tmp_path)
    finish(here)
    tuning = here.preset().tuning
    assert tuning is not None
    assert tuning.note is None
    first = EntryStore.create(here.runs, here.trials[0].entry).seed(here.trials[0].seeds[0])
    record = first.record()
    assert record is not None
    origin = record.provenance[0].changed(device={"kind": "cuda", "name": "NVIDIA H200"})
    first.write_record(record.changed(provenance=[origin]))
    again = search.Search(request(tiny_task), tmp_path)
    assert finish(again).trained == 0
    tuning = again.preset().tuning
    assert tuning is not None
    assert tuning.note == "trials trained on NVIDIA H200"


def test_tuning_seeds_are_not_protocol_seeds() -> None:
    assert search.tuning_seeds("3") == (1_000_000, 1_000_001, 1_000_002)
    assert search.tuning_seeds("1000005:1000007") == (1_000_005, 1_000_006)
    with pytest.raises(OptionError, match="write --seeds 20 for 1000000 to 1000019"):
        search.tuning_seeds("0:20")


def test_settings_chosen_on_protocol_seeds_are_marked() -> None:
    record = {
        "task": "t", "objective": "cell", "value": 1, "sampler": "grid", "trials": 1, "planned": 1,
        "epochs": 1, "steps": 1, "space": {},
    }  # fmt: skip
    assert preset.TuningRecord.model_validate({**record, "seeds": "0:20"}).on_protocol_seeds
    assert not preset.TuningRecord.model_validate({**record, "seeds": "1000000:1000020"}).on_protocol_seeds


@pytest.mark.parametrize(
    "path", sorted((PUBLISHED / "cartpole").glob("reinforce-*/entry.json")), ids=lambda p: p.parent.name
)
def test_published_entries_carry_the_tuning_of_the_preset_they_use(path: Path) -> None:
    record = EntryStore(path.parent).record()
    model = record.identity.model
    entry = resolve("cartpole", {"mlp": "mlp width=16 depth=1"}.get(model, f"{model} qubits=4 layers=1"))
    assert (entry.name, entry.preset) == (path.parent.name, record.preset)
    assert record.tuned == entry.tuning
    assert record.tuning is not None
    assert (record.tuning.trials, record.tuning.seeds) == (7, "1000000:1000010")
    assert not record.tuning.on_protocol_seeds


def test_a_record_of_tuning_in_an_entry_is_checked_and_marked(tmp_path: Path) -> None:
    shutil.copy(PUBLISHED / "beam6g" / "ddqn-mlp-333341ef" / "entry.json", tmp_path)
    store, record = EntryStore(tmp_path), json.loads((tmp_path / "entry.json").read_text())
    assert store.record().tuned == record["tuning"], "nulls are what is not known"

    def rewritten(**changes: Any) -> EntryStore:
        tuning = {**record["tuning"], **changes}
        (tmp_path / "entry.json").write_text(json.dumps({**record, "tuning": tuning}))
        return store

    marked = rewritten(on_protocol_seeds=False).record().tuned
    assert marked["on_protocol_seeds"], "its seeds say so, whatever it says itself"
    for changes in ({"trials": "many"}, {"trails": 3}, {"steps": -1}):
        with pytest.raises(StoreError, match="is not an entry's record"):
            rewritten(**changes).record()


def test_worth_by_hand() -> None:
    """Two runs of four epochs of 10 steps, at thresholds 0.5 and 0.8."""
    curves = np.array([[0.1, 0.6, 0.9, 0.9], [0.1, 0.1, 0.6, 0.7]])
    worth = objective.merit(curves, RANKING, 10, "cell")
    # P_hat at 0.8: 0, 0, 1/2, 1/2 -> below 1/2 for 2 epochs, below 1 for 4; at 0.5: 0, 1/2, 1, 1 -> 1 and 2
    assert (worth.cell, worth.area, worth.unsettled) == (20, (10 + 20 + 20 + 40) / 4, False)
    assert worth.value == 20
    assert objective.merit(curves, RANKING, 10, "area").value == 22.5
    better = objective.merit(np.minimum(curves + 0.01, 1), RANKING, 10, "cell")
    assert better.order < worth.order, "equal sample complexities are told apart by the scores"
    assert 0 < worth.signal - better.signal < 5
    assert objective.merit(np.zeros((2, 4)), RANKING, 10, "cell").unsettled
    # below 0.5: 1 and 2 epochs, below 0.8: 2 and 4
    assert worth.time == objective.merit(curves, RANKING, 10, "time").value == (10 + 20 + 20 + 40) / 4


def test_the_papers_grids_have_its_sizes() -> None:
    grid = space.load("paper")
    sizes = {
        (model, algorithm): samplers.size(space.space(resolve("beam6g", model, algorithm), grid))
        for model in ("mlp", "vqc-native")
        for algorithm in ("ddqn", "ppo")
    }
    assert sizes == {
        ("mlp", "ddqn"): 3 * 4 * 2 * 5 * 3 * 2 * 3,
        ("vqc-native", "ddqn"): 3 * 4 * 4 * 3,
        ("mlp", "ppo"): 4 * 5 * 5 * 3 * 2 * 3,
        ("vqc-native", "ppo"): 4 * 3 * 3 * 3,
    }


def test_options_that_vary_as_one_get_one_value(tiny_task: str) -> None:
    entry = resolve(tiny_task, "vqc-native")
    (dimension,) = space.space(entry, None, varied("activation_in+activation_out=relu,tanh"))
    settings = space.settings({dimension.name: "tanh"})
    assert {setting.name for setting in settings} == {"activation_in", "activation_out"}
    assert {setting.value for setting in settings} == {"tanh"}
    assert space.text({dimension.name: "tanh"}) == "activation_in+activation_out=tanh"


def test_set_takes_an_option_out_of_the_grid(tiny_task: str) -> None:
    grid = space.load("paper")
    names = [d.name for d in space.space(resolve(tiny_task, "mlp"), grid, fixed=[parse_setting("lr=1e-3")])]
    assert "algorithm.gamma" in names
    assert "algorithm.lr" not in names


def test_an_unknown_option_is_named_as_it_was_typed(tiny_task: str) -> None:
    entry = resolve(tiny_task, "mlp")
    with pytest.raises(OptionError, match=r"^--vary widht: no option of that name; did you mean 'width'"):
        space.space(entry, None, [space.parse_varied("widht=8,16")])


def test_drawn_points_repeat_extend_and_stay_in_range(tiny_task: str) -> None:
    words = varied("lr={low = 1e-4, high = 1e-2, log = true}", "batch={low = 8, high = 64}", "gamma=.9,.99")
    dimensions = space.space(resolve(tiny_task, "mlp"), None, words)

    def points(trials: int, seed: int = 0) -> list[space.Point]:
        return samplers.points("random", dimensions, trials, seed)

    twelve = points(12)
    assert points(12) == twelve
    assert points(5) == twelve[:5]
    assert points(12, seed=1) != twelve
    assert all(1e-4 <= p["algorithm.lr"] <= 1e-2 and 8 <= p["algorithm.batch"] <= 64 for p in twelve)
    assert all(isinstance(p["algorithm.batch"], int) for p in twelve)


def test_random_combinations_are_distinct_and_no_more_than_there_are(tiny_task: str) -> None:
    dimensions = space.space(resolve(tiny_task, "mlp"), None, varied("lr=.1,.2,.3"))
    points = samplers.points("random", dimensions, 9, 0)
    assert sorted(point["algorithm.lr"] for point in points) == [0.1, 0.2, 0.3]


def test_small_ranges_are_drawn_until_nothing_new_comes(tiny_task: str) -> None:
    dimensions = space.space(resolve(tiny_task, "mlp"), None, varied("batch={low = 1, high = 4}"))
    points = samplers.points("random", dimensions, 10, 0)
    assert sorted(point["algorithm.batch"] for point in points) == [1, 2, 3, 4]


def test_what_another_process_trains_is_waited_for(tiny_task: str, tmp_path: Path) -> None:
    def elsewhere(entries: Sequence[Entry], seeds: Sequence[int], epochs: int) -> list[EntryStore]:
        return [EntryStore.create(tmp_path, entry) for entry in entries]

    what = search.Search(request(tiny_task), tmp_path)
    while not what.over:
        assert what.step(elsewhere) == [None]
    assert (what.asked, len(what.pending)) == (4, 4)
    with pytest.raises(OptionError, match="no trial has finished"):
        what.preset()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"varied": ()}, "algorithm.lr is a range, and sampler 'grid' needs a list"),
        (
            {"varied": (), "settings": (*SETTINGS, *FIXED, parse_setting("lr=1e-3"))},
            "nothing is varied",
        ),
        ({"varied": varied("widht=1,2")}, "did you mean 'width'"),
        ({"varied": varied("lr=-1,2")}, "a trial with algorithm.lr = -1"),
        ({"varied": varied("lr=[]")}, "the list of values to try is empty"),
        ({"varied": varied("lr={low = 2, high = 1}")}, "low < high is needed"),
        ({"varied": varied("lr={low = 1, high = inf}")}, "finite"),
        ({"varied": varied("lr={low = 1, high = 2}")}, "is a range, and sampler 'grid' needs a list"),
        ({"trials": 2}, "--sampler 'random trials=2'"),
        ({"sampler": "random"}, "'random trials=50'"),
    ],
)
def test_bad_requests(changes: dict[str, Any], message: str, tiny_task: str) -> None:
    with pytest.raises(QrlSuiteError) as refused:
        search.Search(request(tiny_task, **changes), Path("nowhere"))
    assert message in str(refused.value)


GOOD = 'format_version = 1\nalgorithm = "ddqn"\nmodel = "mlp"\n'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (GOOD + "algoritm_options = {}", "unknown key 'algoritm_options'; did you mean 'algorithm_options'"),
        (GOOD + "[tuning]\ntaks = 'x'", "unknown key 'taks' in [tuning]; did you mean 'task'"),
        (GOOD + "[algorithm_options]\nlrr = 1", "algorithm 'ddqn' has no option 'lrr'; did you mean 'lr'"),
        (GOOD + "[model_options]\nwidth = 0", "model 'mlp': width = 0"),
        (GOOD.replace('"mlp"', '"vqc-native"'), "holds settings for model 'vqc-native', not for 'mlp'"),
        ('format_version = 1\nmodel = "mlp"', "missing key 'algorithm'"),
        ("= 1", "not valid TOML"),
        (None, "cannot be read"),
    ],
)
def test_bad_preset_files(content: str | None, message: str, tiny_task: str, tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(QrlSuiteError) as refused:
        resolve(tiny_task, "mlp", preset=str(path))
    assert message in str(refused.value)
    assert "p.toml" in str(refused.value)


def test_values_of_every_type_survive_a_preset_file() -> None:
    values = {"a": True, "b": 1e-05, "c": 'q"\\\n', "d": [1, 2.5, "x"], "e f": {"g": [{"h": 1}]}}
    file = preset.PresetFile(
        format_version=1, algorithm="x", model="y", algorithm_options={**values, "none": None}
    )
    import tomllib

    assert tomllib.loads(preset.dumps(file, "a comment\nof two lines"))["algorithm_options"] == values


def test_bad_grid_files(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="unknown grid 'papre'; did you mean 'paper'"):
        space.load("papre")
    path = tmp_path / "g.toml"
    for content in ("format_version = 1", "format_version = 1\n[search.all.al]\nlr = [1]", "x ="):
        path.write_text(content)
        with pytest.raises(FileError, match=r"g\.toml"):
            space.load(str(path))
