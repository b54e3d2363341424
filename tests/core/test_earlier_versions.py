"""What earlier versions wrote: hashes stay, and their interrupted runs end with the bytes they would have ended with.

`tests/golden/make.py` wrote the files, once per version. On the kind of machine and with the versions of torch, numpy
and numba that made them, results are compared byte for byte. Elsewhere floating-point sums round differently, and the
same runs are compared with a tolerance: that finds another stream, option or formula, not another order of a sum.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file

from qrlsuite.engine import missing
from qrlsuite.engine.where import Where
from qrlsuite.engine.worker import train_group
from qrlsuite.experiment.entry import resolve
from qrlsuite.experiment.task import load
from qrlsuite.leaderboard.shelf.published import PUBLISHED
from qrlsuite.results.codes import ChangedCodeError
from qrlsuite.results.records import EntryRecord
from qrlsuite.results.store import EntryStore, json_line
from tests.golden.make import EPOCHS, GOLDEN, SEEDS, machine

VERSIONS = sorted(path.parent for path in GOLDEN.glob("v*/hashes.json"))
RUNS = [path.parent for version in VERSIONS for path in sorted(version.glob("interrupted/*/*/entry.json"))]
CHANGES = {
    "mlp": ("v0.2.0", "model 'mlp' has numerics 2, and had 1"),
    "vqc": ("v0.2.0", "model 'vqc-native' has numerics 2, and had 1"),
    "ppo": ("v0.2.0", "algorithm 'ppo' has numerics 2, and had 1"),
    "reinforce": ("v0.2.0", "algorithm 'reinforce' has numerics 2, and had 1"),
}
"""By part, the version since which its bits are others: networks and circuits are compiled sweeps, and learn without
autograd. Seeds that earlier versions began are another entry, and trained anew they are compared number by number."""
TOLERANCE = 1e-4
"""With torch's kernels for other processors (ATEN_CPU_CAPABILITY=default) lines differ by 1e-7 at most. Parameters are
not compared: angles without influence on the result follow rounding errors alone, and Adam makes steps of them."""


def stored(version: Path, name: str) -> Any:
    return json.loads((version / f"{name}.json").read_text())


@pytest.mark.parametrize("version", VERSIONS, ids=lambda path: path.name)
def test_tasks_and_plain_commands_keep_their_hashes(version: Path) -> None:
    hashes = stored(version, "hashes")
    assert {name: load(name).hash for name in hashes["tasks"]} == hashes["tasks"]
    entries = {}
    for words in hashes["entries"]:
        task, algorithm, model = words.split()
        entries[words] = resolve(task, model, algorithm).hash
    assert entries == hashes["entries"]


@pytest.mark.parametrize("version", VERSIONS, ids=lambda path: path.name)
def test_published_entries_keep_their_hashes(version: Path) -> None:
    for record in stored(version, "hashes")["published"]:
        entry = EntryRecord.read(record, record["name"]).entry("")  # raises where the hash is another one
        kept = ("name", "hash", "label", "task_hash", "identity")
        assert {name: EntryRecord.of(entry).content[name] for name in kept} == {
            name: record[name] for name in kept
        }
        there = EntryStore(PUBLISHED / record["task_name"] / record["name"]).record()
        assert {name: there.content[name] for name in kept} == {name: record[name] for name in kept}


@pytest.mark.parametrize("run", RUNS, ids=lambda path: path.name)
@pytest.mark.parametrize("begun", [True, False], ids=["resumed", "from nothing"])
def test_runs_end_as_they_did(
    run: Path, begun: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / run.parent.name / run.name
    folder.mkdir(parents=True)
    if begun:
        shutil.copytree(run, folder, dirs_exist_ok=True)
    else:
        shutil.copy(run / "entry.json", folder)
    version = run.parents[2]
    changes = [
        why for part, (since, why) in CHANGES.items() if part in run.name.split("-") and version.name < since
    ]
    if begun and changes:
        with pytest.raises(ChangedCodeError) as refused:
            train_group(folder, SEEDS, EPOCHS)
        assert all(why in str(refused.value) for why in changes)
        entry = EntryStore(folder).entry()
        missing.settle_codes(tmp_path, [entry], Where.create())
        assert missing.find(tmp_path, entry, Where.create()).store.mark
        assert capsys.readouterr().err.count(f"{changes[0]}. Training starts over as '") == 1
        return
    train_group(folder, SEEDS, EPOCHS)
    same_bits = stored(version, "machine") == machine() and not changes
    for seed in SEEDS:
        ended = EntryStore(folder).seed(seed)
        expected = version / "finished" / run.parent.name / run.name / ended.path.name
        stated = json.loads((expected / "epochs.jsonl").read_bytes().splitlines()[0])
        lines = b"".join(json_line(_without_later(row.content, stated)) for row in ended.epochs())
        if same_bits:
            assert lines == (expected / "epochs.jsonl").read_bytes()
            trained = (ended.path / "final.safetensors").read_bytes()
            assert trained == (expected / "final.safetensors").read_bytes()
        require_alike(lines, expected / "epochs.jsonl")
        agent, stated = (load_file(path / "final.safetensors") for path in (ended.path, expected))
        assert {name: array.shape for name, array in agent.items()} == {
            name: array.shape for name, array in stated.items()
        }


def _without_later(row: dict[str, Any], stated: dict[str, Any]) -> dict[str, Any]:
    """Return what is recorded of an epoch without gradient norms, where they were not."""
    return {name: value for name, value in row.items() if name in stated or "gradient_norm" not in name}


def require_alike(lines: bytes, expected: Path) -> None:
    """Compare epochs number by number."""
    here = [json.loads(line) for line in lines.splitlines()]
    there = [json.loads(line) for line in expected.read_bytes().splitlines()]
    assert [row.keys() for row in here] == [row.keys() for row in there]
    for ours, stated in zip(here, there):
        for name, value in stated.items():
            if isinstance(value, dict | None):
                assert ours[name] == value, name
            else:
                np.testing.assert_allclose(ours[name], value, atol=TOLERANCE, rtol=TOLERANCE, err_msg=name)
