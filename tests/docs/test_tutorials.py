"""The tutorials run, on budgets of seconds; and what they show of published entries is what comes out now."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from qrlsuite import registry

pytest.importorskip("IPython", reason="needs the extra 'docs'")

ROOT = Path(__file__).parents[2]
NOTEBOOKS = {path.stem: path for path in sorted((ROOT / "docs" / "tutorials").glob("*.ipynb"))}
SIZES = "few, many, seeds, epochs = 1, 2, 2, 2"
"""What stands in for a tutorial's own sizes."""
STORE = "`make tutorials` executes and stores them; then read the sentences beside what has changed"

Outputs = list[dict[str, Any]]


def cells(name: str) -> list[dict[str, Any]]:
    """Return the code cells of a tutorial."""
    return [cell for cell in json.loads(NOTEBOOKS[name].read_text())["cells"] if cell["cell_type"] == "code"]


def texts(outputs: Outputs) -> list[str]:
    """Return what is shown as text: tables, too, and of a picture its size. What was printed is one text."""
    printed = "".join(text for each in outputs for text in each.get("text", []))
    shown = ["".join(each["data"]["text/plain"]) for each in outputs if "data" in each]
    return [text.rstrip() for text in [printed, *shown] if text]


def kinds(outputs: Outputs) -> list[set[str]]:
    """Return in which formats outputs are shown."""
    printed = any("text" in each for each in outputs)
    return [{"text"}] * printed + [set(each["data"]) for each in outputs if "data" in each]


@pytest.fixture(scope="module")
def shell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """An IPython in this process: kernels of their own would spend most of their time on imports."""
    from IPython.core.interactiveshell import InteractiveShell
    from traitlets.config import Config

    from qrlsuite.engine.terminal import show_figures_in_notebook

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("IPYTHONDIR", str(tmp_path_factory.mktemp("ipython")))
        patch.delenv("VIRTUAL_ENV", raising=False)  # of a shell's other environment, which IPython warns of
        quiet = Config({"HistoryManager": {"enabled": False}})
        shell = InteractiveShell.instance(config=quiet, user_module=ModuleType("tutorial"))
        shell.display_formatter.active_types = shell.display_formatter.format_types  # as in a notebook
        show_figures_in_notebook()  # which `qrlsuite.api` does when it is imported
        yield shell
        InteractiveShell.clear_instance()
        sys.modules.pop("tutorial", None)


@pytest.fixture
def run(
    shell: Any, tiny_task: str, forked_workers: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[str], list[Outputs]]]:
    """Run a tutorial's cells one after the other; returns the outputs of each."""
    from IPython.utils.capture import capture_output

    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "docs" / "tutorials" / "data", "data")

    def run(name: str) -> list[Outputs]:
        found = []
        for cell in cells(name):
            small = f"{SIZES}; task = {tiny_task!r}"
            sizes = "parameters" in cell["metadata"].get("tags", [])
            values: list[Any] = []
            shell.display_trap.hook = values.append
            with capture_output() as captured:
                done = shell.run_cell(small if sizes else "".join(cell["source"]))
            done.raise_error()
            printed = [{"text": captured.stdout}] if captured.stdout else []
            shown = [shell.display_formatter.format(value)[0] for value in values if value is not None]
            found.append(
                [*printed, *({"data": data} for data in [*(each.data for each in captured.outputs), *shown])]
            )
        return found

    yield run
    shell.reset(new_session=False)
    registry.load.cache_clear()
    sys.modules.pop("crx_ring", None)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_tutorial_runs_and_is_stored_with_its_output(
    name: str, run: Callable[[str], list[Outputs]]
) -> None:
    found, stored = run(name), [cell["outputs"] for cell in cells(name)]
    assert [kinds(outputs) for outputs in stored] == [kinds(outputs) for outputs in found], STORE
    tagged = any("parameters" in cell["metadata"].get("tags", []) for cell in cells(name))
    assert tagged == (name not in ("read-a-verdict", "judge-curves")), "these train nothing"
    if not tagged:
        assert [texts(outputs) for outputs in stored] == [texts(outputs) for outputs in found], STORE


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_stored_output_has_no_error_and_no_path_of_a_machine(name: str) -> None:
    for cell in cells(name):
        for output in cell["outputs"]:
            assert output["output_type"] != "error", STORE
            assert output.get("name") != "stderr", texts([output])
            shown = "".join(texts([output])) + "".join(output.get("data", {}).get("text/html", ""))
            for folder in ("/home/", "/root/", "/tmp/", "/Users/", "/usr/", str(ROOT), str(Path.home())):
                assert folder not in shown, STORE
