"""Plugins whose seeds are not what they are alone: what `run` says of them."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from qrlsuite.engine.probe import Side, difference, unpack
from tests.conftest import HANGS, TINY, install, installed

PLUGIN = """
from qrlsuite import hookimpl, specs

@hookimpl
def register_models(register):
    for name in {models!r}:
        register(specs.ModelSpec(name, "bad", family="classical", options="bad_plugins:Options",
                                 build=f"bad_plugins:{{name}}"))

@hookimpl
def register_environments(register):
    for name in {environments!r}:
        register(specs.EnvironmentSpec(name, "bad", options="bad_plugins:Options", gymnasium_id=f"bad/{{name}}-v0",
                                       entry_point=f"bad_plugins:{{name.title().replace('_', '')}}"))
"""

PROBE, HIDDEN, STREAMS = (
    "",
    "is changed by a forward pass",
    "the same streams and actions give other observations",
)
"""What `run` asks before training refuses it, or the probe alone does."""

MODELS: dict[str, str | None] = {
    "good": None,
    "torch_in_build": None,
    "class_attribute": PROBE,
    "module_global": PROBE,
    "build_counter": PROBE,
    "urandom_in_forward": PROBE,
    "cache_by_shape": PROBE,
    "plain_integer": PROBE,
    "torch_in_forward": "a pass moves torch's default generator",
    "recurrent_buffer": HIDDEN,
}
ENVIRONMENTS: dict[str, str | None] = {
    "hop": None,
    "lanes_share_a_list": STREAMS,
    "environment_counter": STREAMS,
    "numpy_in_reset": STREAMS,
}
"""What `run` says of each, None where it trains: a number that `build` draws follows from the seed."""

SIDES = """
import json, sys
from pathlib import Path
from qrlsuite.engine.probe import pack, train
from qrlsuite.errors import QrlSuiteError
from qrlsuite.experiment.entry import resolve
from qrlsuite.training.trainer import require_trainable
out, seeds, cases = Path(sys.argv[1]), json.loads(sys.argv[2]), json.loads(sys.argv[3])
for name, (task, model) in cases.items():
    header, arrays = {"refused": ""}, {}
    entry = resolve(task, model)
    try:
        side = train(entry, seeds, 2)
        header, arrays = {**header, "lines": side.lines}, side.arrays
        require_trainable([entry])  # before, and in another process
    except QrlSuiteError as error:
        header["refused"] = str(error)
    (out / name).write_bytes(pack(header, arrays))
"""
"""Does for all of them, one after the other in one process, what a group and its probe do."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bad") / "site"
    folder.mkdir()
    install(folder, "bad", PLUGIN.format(models=list(MODELS), environments=list(ENVIRONMENTS)))
    shutil.copy(Path(__file__).parent / "bad_plugins.py", folder)
    return folder


def cases(folder: Path) -> dict[str, tuple[str, str]]:
    """Return task and model by plugin."""
    (folder / "tiny.toml").write_text(TINY)
    found = {name: (str(folder / "tiny.toml"), name) for name in MODELS}
    begin, end = TINY.index("[environment]"), TINY.index("[protocol]")
    for name in ENVIRONMENTS:
        text = TINY[:begin] + f'[environment]\nname = "{name}"\n' + TINY[end:]
        (folder / f"{name}.toml").write_text(text.replace('name = "tiny"', f'name = "{name}"'))
        found[name] = (str(folder / f"{name}.toml"), "mlp")
    return found


@pytest.fixture(scope="module")
def verdicts(site: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, str]]:
    """What each plugin is refused for before training, and what the probe finds; empty for nothing."""
    folder = tmp_path_factory.mktemp("sides")
    given, processes = cases(folder), []
    for where, seeds in (("together", [0, 1, 2]), ("alone", [1])):
        (folder / where).mkdir()
        words = [sys.executable, "-c", SIDES, str(folder / where), json.dumps(seeds), json.dumps(given)]
        environment = {**installed(site), "OMP_NUM_THREADS": "1"}
        processes.append(subprocess.Popen(words, env=environment))
    assert [process.wait(HANGS) for process in processes] == [0, 0]
    found: dict[str, tuple[str, str]] = {}
    for name in given:
        sides = []
        for where in ("together", "alone"):
            header, arrays = unpack((folder / where / name).read_bytes())
            sides.append(Side(header.get("lines", []), arrays))
        found[name] = header["refused"], difference(*sides)
    return found


@pytest.mark.parametrize("name", [*MODELS, *ENVIRONMENTS])
def test_what_run_says(name: str, verdicts: dict[str, tuple[str, str]]) -> None:
    expected = {**MODELS, **ENVIRONMENTS}[name]
    refused, differs = verdicts[name]
    assert (expected or "") in refused
    assert bool(expected) == bool(refused)
    if expected in (PROBE, STREAMS) or name == "torch_in_forward":
        assert re.match(r"'\w+' of epoch \d|the state '[\w.]+' after epoch \d", differs)
    else:
        assert not differs
