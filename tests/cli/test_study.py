"""Studies at work: each is trained and drawn; order, budgets, sharing, interruptions."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
from collections.abc import Sequence
from pathlib import Path

import pytest
import tomli_w

from qrlsuite import registry, specs
from qrlsuite.engine.api import EngineOutcome, Show, Work
from qrlsuite.engine.where import Where
from qrlsuite.engine.worker import train_group
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError
from qrlsuite.experiment import task
from qrlsuite.leaderboard import studies
from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.leaderboard.studies import find
from qrlsuite.results.store import EntryStore
from qrlsuite.specs import EngineSpec, StudySpec
from qrlsuite.studies.runner import find_missing
from tests.commands import answer, qrlsuite, say, start
from tests.conftest import HANGS, TINY, Hold, results
from tests.leaderboard import boards

STUDY = """
format_version = 1
name = "widths"
summary = "Two small networks and a circuit"

[[entries]]
name = "mlp"
task = "TASK"
model = "mlp"
grid = { width = [16, 4] }

[[entries]]
name = "vqc"
task = "TASK"
model = "vqc-native"
options = { qubits = 2, layers = 1 }

[[pictures]]
name = "curves"
kind = "curves"

[[pictures]]
name = "scaling"
kind = "scaling"
entries = ["mlp"]
settings = { by = "width" }
"""


class Here:
    """An engine that trains in this process: quick, where starting processes would take most of the time."""

    trained: list[tuple[str, tuple[int, ...]]] = []

    def __init__(self, options: None = None) -> None:
        pass

    def workers(self, asked: int | None) -> int:
        return asked or 1

    def queued(self, store: EntryStore) -> set[int]:
        return set()

    def run(self, works: Sequence[Work], show: Show) -> EngineOutcome:
        [work] = works
        for group in work.groups:
            train_group(work.store.path, group.seeds, work.epochs)
            self.trained.append((work.store.record().label, group.seeds))
        return EngineOutcome()


class Queue(Here):
    """An engine that hands work over and leaves."""

    waiting: dict[str, set[int]] = {}

    def queued(self, store: EntryStore) -> set[int]:
        return self.waiting.get(store.path.name, set())

    def run(self, works: Sequence[Work], show: Show) -> EngineOutcome:
        [work] = works
        seeds = {seed for group in work.groups for seed in group.seeds}
        self.waiting.setdefault(work.store.path.name, set()).update(seeds)
        return EngineOutcome(submitted=f"{len(seeds)} seeds submitted")


@pytest.fixture(autouse=True)
def engines(monkeypatch: pytest.MonkeyPatch) -> None:
    known = registry.load().entries[specs.EngineSpec]
    for name, cls in (("here", Here), ("queue", Queue)):
        spec = EngineSpec(name, "for tests", f"{__name__}:{cls.__name__}")
        monkeypatch.setitem(known, name, registry.Registered(spec, "tests"))
    Here.trained.clear()
    Queue.waiting.clear()


@pytest.fixture
def widths(tmp_path: Path) -> str:
    (tmp_path / "tiny.toml").write_text(TINY)
    path = tmp_path / "widths.toml"
    path.write_text(STUDY.replace("TASK", str(tmp_path / "tiny.toml")))
    return str(path)


def test_other_entries_go_on_where_one_fails(
    widths: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first of three that are trained: the one that lacks least, in order."""
    run = Here.run

    def failing(self: Here, works: Sequence[Work], show: Show) -> EngineOutcome:
        if "width=16" in works[0].store.record().label:
            raise StoreError("no room")
        return run(self, works, show)

    monkeypatch.setattr(Here, "run", failing)
    words = ("study", "run", widths, "--engine", "here", "--seeds", "1", "--epochs", "1")
    with pytest.raises(StoreError, match=r"^ddqn mlp width=16: no room$"):
        say(*words, "--runs", str(tmp_path / "runs"))
    assert [label for label, _ in Here.trained] == ["ddqn mlp width=4", "ddqn vqc-native qubits=2 layers=1"]


STUDIES = [name for name, each in registry.load().of(StudySpec).items() if each.distribution == "qrlsuite"]
ALIKE = ("fig6", "fig7", "cartpole", "ppo", "ablation", "degree", "ansatz", "stacking", "fidelity", "buffer")
"""Studies whose pictures are of kinds that others have, too."""
SIZES = {"qubits": "[2, 3]", "layers": "[1, 2]", "width": "[4, 8]", "depth": "[1, 2]", "shots": "[2, 4]"}
"""Grids of sizes, and what they become."""
QUOTED = r'"[^"]*"'
LONG_LIST = re.compile(rf"\[\s*(?:{QUOTED},\s*){{9,}}(?:{QUOTED})?\s*\]")
"""Ten names and more, of tasks; every tenth is kept."""
REDUCED = {"interactions": 16, "environments": 4, "validation_episodes": 2, "steps": 4}


def reduced(name: str, folder: Path) -> str:
    """Write a study of the suite with small models, and the same tasks at a protocol of moments; returns its path."""
    text = Path(registry.get(specs.StudySpec, name).path).read_text()
    for size, grid in SIZES.items():
        text = re.sub(rf"\b{size} = \[[^]]*\]", f"{size} = {grid}", text)
    text = re.sub(r"qubits = \d+", "qubits = 2", text)
    text = re.sub(r"\b(episodes|trajectories|shots) = \d+", r"\1 = 5", text)
    text = LONG_LIST.sub(lambda found: f"[{', '.join(re.findall(QUOTED, found[0])[::10])}]", text)

    def written(match: re.Match[str]) -> str:
        content = task.load(match[1]).file.model_dump(mode="json", exclude_none=True)
        for key, value in REDUCED.items():
            (table,) = (
                part for part in (content["protocol"], content["environment"]["options"]) if key in part
            )
            table[key] = value
        (folder / f"{match[1]}.toml").write_text(tomli_w.dumps(content))
        return f'"{folder / match[1]}.toml"'

    tasks = re.compile(r'^task = (?:"[^"]*"|\[[^]]*\])', re.MULTILINE)
    (folder / f"{name}-study.toml").write_text(tasks.sub(lambda m: re.sub(r'"([^"]*)"', written, m[0]), text))
    return str(folder / f"{name}-study.toml")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] if name in ALIKE else []) for name in STUDIES]
)
def test_a_study_runs_and_gives_its_pictures(name: str, tmp_path: Path) -> None:
    seeds = 2
    words = [reduced(name, tmp_path), "--seeds", str(seeds), "--epochs", "2"]
    words += ["--engine", "here", "--runs", str(tmp_path / "runs")]
    said = say("study", "run", *words).stdout
    content = answer("study", "run", *words)
    assert content["core_hours_left"] == 0
    assert all(entry["finished"] == seeds for entry in content["entries"])
    assert seeds * len(content["entries"]) == sum(len(group) for _, group in Here.trained), (
        "nothing is trained twice"
    )
    assert said.count("next: ") >= 1
    for place, line in enumerate(said.splitlines()):
        _, *command = shlex.split(line.removeprefix("next: "))
        picture = tmp_path / f"{place}.png"
        few = ["--episodes", "5"] if command[0] == "evaluate" else []
        drawn = answer(*command, *few, "--out", str(picture))
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert few or set(drawn["seeds"].values()) == {seeds}


DEPLOYED = """
format_version = 1
name = "there"
summary = "Trained agents elsewhere"

[[entries]]
name = "all"
task = "TASK"
model = ["vqc-native qubits=2 layers=1", "mlp"]

[[pictures]]
kind = "deployed"

[pictures.evaluation]
best = 2
episodes = 3
deployed = { backend = "native", vary = "shots", values = [1, 50] }
"""


def test_agents_of_a_study_act_on_a_backend_once(tmp_path: Path) -> None:
    (tmp_path / "tiny.toml").write_text(TINY)
    path, runs = tmp_path / "there.toml", tmp_path / "runs"
    path.write_text(DEPLOYED.replace("TASK", str(tmp_path / "tiny.toml")))
    with pytest.raises(QrlSuiteError, match="study 'there' has no seeds yet: qrlsuite study run"):
        say("plot", "picture", "--study", str(path))
    say("study", "run", str(path), "--seeds", "2", "--epochs", "1", "--engine", "here", "--runs", str(runs))
    words = ["plot", "picture", "--study", str(path), "--runs", str(runs)]
    picture = Path(answer(*words)["picture"])
    kept = sorted(runs.rglob("evaluations/*.jsonl"))
    assert len(kept) == 2, "one for each value; the network has no circuit"
    before, figure = [path.read_bytes() for path in kept], picture.read_bytes()
    assert Path(answer(*words)["picture"]).read_bytes() == figure
    assert [path.read_bytes() for path in kept] == before


def test_entries_are_shared_with_plain_runs_and_between_studies(widths: str, tmp_path: Path) -> None:
    runs = str(tmp_path / "runs")
    plain = ["run", "mlp width=16", "--task", str(tmp_path / "tiny.toml"), "--runs", runs, "--engine", "here"]
    done = say(*plain)
    assert done.exit_code == 0
    assert "it should take" not in done.stderr
    (folder,) = (tmp_path / "runs" / "tiny").iterdir()
    before = results(folder, 3)
    content = answer("show", widths, "--runs", runs)
    assert [entry["finished"] for entry in content["entries"]] == [4, 0, 0]
    assert [entry["core_seconds_range"] for entry in content["entries"]] == [[0, 0], None, None]
    shown = say("show", widths, "--runs", runs).stdout
    assert "left: 2 entries of unknown cost, until a first epoch is trained" in shown
    longer = ("study", "run", widths, "--epochs", "600", "--dry-run", "--runs", runs)
    content = answer(*longer)
    low, high = content["core_hours_range"]
    assert 0 < low < content["core_hours_left"] < high
    assert [entry["core_seconds_range"] is None for entry in content["entries"]] == [False, True, True]
    assert re.search(r"left: .* core-hours, and 2 entries of unknown cost\)", say(*longer).stdout)
    Here.trained.clear()
    say("study", "run", widths, "--engine", "here", "--runs", runs)
    assert sorted(label for label, _ in Here.trained) == [
        "ddqn mlp width=4",
        "ddqn vqc-native qubits=2 layers=1",
    ]
    assert results(folder, 3) == before
    words = ["export", widths, "--runs", runs, "--out", str(tmp_path / "out")]
    assert say(*words).stdout.count("wrote ") == 3


def test_show_and_dry_run_write_nothing(widths: str, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    for words in (
        ("show", widths),
        ("study", "run", widths, "--dry-run"),
    ):
        result = say(*words, "--runs", str(runs))
        assert result.exit_code == 0
        assert "vqc-native" in result.stdout
    assert not runs.exists()
    planned = answer("study", "run", widths, "--dry-run", "--runs", str(runs))
    assert planned["entries"] == answer("show", widths, "--runs", str(runs))["entries"]
    assert not runs.exists()


def test_a_study_without_entries_has_nothing_to_train(tmp_path: Path) -> None:
    path = tmp_path / "empty.toml"
    path.write_text('format_version = 1\nname = "empty"\nsummary = "None"\n[[pictures]]\nkind = "curves"\n')
    assert answer("study", "run", str(path), "--runs", str(tmp_path))["entries"] == []
    assert "nothing to train" in say("show", str(path)).stdout
    with pytest.raises(OptionError, match="has no entry"):
        say("plot", "curves", "--study", str(path))


def test_only_keeps_words_of_labels_but_no_part_of_a_hash(widths: str) -> None:
    steps = answer("study", "run", widths, "--dry-run")["entries"]
    first = steps[0]["entry"]
    part = next(
        first[-8:][i : i + 3] for i in range(6) if first[-8:][i : i + 3] not in str(steps[0]["label"])
    )
    assert [step["entry"] for step in answer("study", "run", widths, "--dry-run", first)["entries"]] == [
        first
    ]
    assert len(answer("study", "run", widths, "--dry-run", "mlp")["entries"]) == 2
    with pytest.raises(OptionError, match="has no such entry"):
        say("study", "run", widths, "--dry-run", part)


def test_the_entry_that_lacks_least_is_first_and_a_budget_is_one_for_all(widths: str, tmp_path: Path) -> None:
    words = (widths, "--engine", "here", "--runs", str(tmp_path / "runs"))
    for more in (("mlp width=4", "--seeds", "2"), ("--budget", "0.000001s"), ("--budget", "1h")):
        say("study", "run", *words, *more)
    assert Here.trained == [
        ("ddqn mlp width=4", (0, 1)),
        ("ddqn mlp width=4", (2, 3)),
        ("ddqn mlp width=16", (0, 1, 2, 3)),
        ("ddqn vqc-native qubits=2 layers=1", (0, 1, 2, 3)),
    ]


def test_a_picture_of_a_study_shows_its_group_without_short_entries(widths: str, tmp_path: Path) -> None:
    words = ("--seeds", "2", "--engine", "here", "--runs", str(tmp_path / "runs"))
    say("study", "run", widths, "mlp width=16", "vqc", "--epochs", "2", *words)
    say("study", "run", widths, "mlp width=4", "--epochs", "1", *words)
    drawn = say("plot", "scaling", "--study", widths, "--runs", str(tmp_path / "runs"))
    assert "left out: ddqn mlp width=4: ends at " in drawn.stderr
    assert f"wrote {tmp_path}/runs/study-widths-scaling.png" in drawn.stdout
    seeds = answer("plot", "scaling", "--study", widths, "--runs", str(tmp_path / "runs"))["seeds"]
    assert [name.partition("-")[2][:3] for name in seeds] == ["mlp"]
    with pytest.raises(OptionError, match="has no complete run of seed 2"):
        say("plot", "scaling", "--study", widths, "--seeds", "3", "--runs", str(tmp_path / "runs"))


def test_an_engine_that_hands_over_is_given_everything_once(widths: str, tmp_path: Path) -> None:
    words = (widths, "--engine", "queue", "--runs", str(tmp_path / "runs"))
    said = say("study", "run", *words)
    assert said.stdout.count("4 seeds submitted") == 3
    again = answer("study", "run", *words)
    assert "submitted" not in again
    assert [entry["busy"] for entry in again["entries"]] == [4, 4, 4]


def test_ctrl_c_saves_and_the_same_command_resumes(widths: str, tmp_path: Path, hold: Hold) -> None:
    runs = tmp_path / "runs"
    words = ["study", "run", widths, "mlp width=16"]
    words += ["--epochs", "8", "--seeds", "2", "--workers", "1", "--runs"]
    process = start(*words, str(runs), env=hold.environment)
    hold.wait(process)
    os.kill(process.pid, signal.SIGINT)
    _, message = process.communicate(timeout=HANGS)
    assert process.returncode == 130, message
    assert "every finished epoch is saved. The same command continues" in message
    assert not list(runs.glob("tiny/*/seed-*/epochs.parquet"))
    for folder in (runs, tmp_path / "straight"):
        assert qrlsuite(*words, str(folder)).returncode == 0
    (folder,) = (runs / "tiny").iterdir()
    (straight,) = (tmp_path / "straight" / "tiny").iterdir()
    assert all(results(folder, seed) == results(straight, seed) for seed in (0, 1))


@pytest.fixture
def two_studies(widths: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Register two studies, and no others: `widths`, and `without-circuit` with one of its entries."""
    wide = tmp_path / "without-circuit.toml"
    text = Path(widths).read_text().replace("[16, 4]", "[16]").replace('"widths"', '"without-circuit"')
    wide.write_text(re.sub(r'\[\[entries\]\]\nname = "vqc".*?(?=\[\[pict)', "", text, flags=re.DOTALL))
    registered = {
        path.stem: registry.Registered(StudySpec(path.stem, "for tests", str(path)), "tests")
        for path in (Path(widths), wide)
    }
    monkeypatch.setitem(registry.load().entries, specs.StudySpec, registered)


@pytest.mark.usefixtures("two_studies")
def test_all_studies_at_once_the_one_that_lacks_least_first(tmp_path: Path) -> None:
    words = ("--engine", "here", "--seeds", "2", "--epochs", "1", "--runs", str(tmp_path / "runs"))
    said = say("study", "run", "all", *words)
    assert said.stderr.index("study without-circuit:") < said.stderr.index("study widths:")
    assert said.stdout.index("--study without-circuit") < said.stdout.index("--study widths")
    assert [label for label, _ in Here.trained].count("ddqn mlp width=16") == 1, (
        "an entry of both is trained once"
    )
    said = say("study", "run", "all", *words, "--budget", "0.000001s")
    assert said.stderr.count("study ") == 1, "the budget of all is used up"
    found = json.loads(say("study", "run", "all", "--dry-run", "--json", *words).stdout)
    assert not any(entry["missing"] for each in found for entry in each["entries"])
    assert {each["name"] for each in found} == {"without-circuit", "widths"}


@pytest.mark.usefixtures("two_studies")
def test_all_skips_studies_without_the_wanted_entries(tmp_path: Path) -> None:
    words = ("vqc", "--runs", str(tmp_path / "runs"))
    [found] = json.loads(say("study", "run", "all", "--dry-run", "--json", *words).stdout)
    assert [entry["label"] for entry in found["entries"]] == ["ddqn vqc-native qubits=2 layers=1"]
    said = say("study", "run", "all", "--dry-run", *words).stderr
    assert said == "left out: vqc: study 'without-circuit' has no such entry\n"
    with pytest.raises(OptionError, match="has no such entry"):
        say("study", "run", "all", "--dry-run", "nothing")
    broken = tmp_path / "widths.toml"
    broken.write_text(broken.read_text().replace('kind = "scaling"', 'kind = "scalin"'))
    with pytest.raises(QrlSuiteError, match="scalin"):  # it is no study without such an entry
        say("study", "run", "all", "--dry-run", *words)


@pytest.mark.usefixtures("two_studies")
def test_show_counts_seeds_and_decided_pairs(tmp_path: Path) -> None:
    runs = str(tmp_path / "runs")
    say("study", "run", "widths", "mlp", "--seeds", "20", "--epochs", "3", "--engine", "here", "--runs", runs)
    widths = answer("show", "widths", "--runs", runs)
    assert [entry["finished"] for entry in widths["entries"]] == [4, 4, 0], (
        "of the four seeds of the protocol"
    )
    assert (widths["decided"], widths["pairs"]) == (0, 1), "two networks that have hardly learned"
    assert "0 of 1 pair decided" in say("show", "widths", "--runs", runs).stdout


def test_published_seeds_count_up_to_the_last_epoch(tmp_path: Path) -> None:
    members = find("ppo").members()
    for epochs, counts in ((500, True), (501, False)):
        works = find_missing(members, tmp_path, Where.create(), None, epochs)
        assert any(studies.published_seeds(works).values()) == counts


def test_which_pairs_count() -> None:
    entries = boards.graded(4)
    ranking = boards.of(entries).sections[0].times
    assert studies.decided_pairs(entries) == (ranking.n_decided, 6)
    assert ranking.n_decided > 0
    planned = boards.changed(entries[0], plan="abc")
    few = entries[1].with_seeds(19)
    assert studies.decided_pairs([planned, few, *entries[2:]])[1] == 1, "of the last two"


def test_listing() -> None:
    listed = say("list", "studies").stdout
    assert all(name in listed for name in (*STUDIES, *published_studies.names()))
    shown = say("show", "fig7", "--runs", "nowhere").stdout
    assert "ddqn vqc-native qubits=14" in shown
    assert "0/100" in shown
    assert "3,567 core-hours" in shown
