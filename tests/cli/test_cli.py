"""The command line as a user meets it: a process, its output, its exit codes."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from qrlsuite.cli import main
from qrlsuite.results import checkpoint
from qrlsuite.results.store import EntryStore
from tests.commands import qrlsuite, start
from tests.conftest import HANGS, TINY, Hold, install, installed, most_epochs, results


@pytest.fixture
def task(tmp_path: Path) -> str:
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return str(path)


def test_run_then_leaderboard_compare_and_plot(task: str, tmp_path: Path) -> None:
    runs = str(tmp_path / "runs")
    for width in ("16", "8"):
        done = qrlsuite("run", "--task", task, "--model", "mlp", "--set", f"width={width}", "--runs", runs)
        assert done.returncode == 0, done.stderr
        assert "4 seeds complete" in done.stderr
        assert f"results: {runs}/" in done.stderr
        assert (f"results go to the new folder {runs};" in done.stderr) == (width == "16")
    again = qrlsuite("run", "ddqn", "mlp", "width=16", "--task", task, "--runs", runs, "--json")
    assert json.loads(again.stdout)["seeds"] == 4

    table = qrlsuite("leaderboard", "--runs", runs)
    assert "undecided: fewer than 20 seeds" in table.stdout
    board = json.loads(qrlsuite("leaderboard", "--runs", runs, "--format", "json").stdout)
    (section,) = board["sections"]
    assert {row["label"] for row in section["rows"]} == {"ddqn mlp width=16", "ddqn mlp width=8"}
    assert all(row["tier"] is None and row["seeds"] == 4 for row in section["rows"])
    markdown = qrlsuite("leaderboard", "--runs", runs, "--format", "markdown").stdout
    assert "| - | mlp width=8 |" in markdown

    compared = qrlsuite("compare", "mlp width=16", "mlp width=8", "--runs", runs)
    assert "undecided: fewer than 20 seeds" in compared.stdout
    drawn = qrlsuite("plot", "curves", "--runs", runs, "--out", str(tmp_path / "c.svg"))
    assert drawn.returncode == 0, drawn.stderr
    assert (tmp_path / "c.svg").read_text().startswith("<?xml")


def test_more_seeds_widen_an_entry(task: str, tmp_path: Path) -> None:
    words = ("run", "--task", task, "--model", "mlp", "--set", "width=16", "--runs", str(tmp_path / "runs"))
    qrlsuite(*words, "--seeds", "0:2")
    entry = next((tmp_path / "runs" / "tiny").iterdir())
    before = results(entry, 0)
    wider = qrlsuite(*words, "--seeds", "3")
    assert "1 seed to epoch 3" in wider.stderr
    assert "2 seeds already there" in wider.stderr
    assert results(entry, 0) == before
    assert EntryStore(entry).seeds() == [0, 1, 2]


def test_ctrl_c_saves_and_the_same_command_resumes(task: str, tmp_path: Path, hold: Hold) -> None:
    def words(runs: str) -> list[str]:
        run = ["run", "--task", task, "--model", "mlp", "--set", "width=16", "--seeds", "3", "--epochs", "8"]
        return [*run, "--runs", str(tmp_path / runs), "--workers", "2"]

    assert qrlsuite(*words("straight")).returncode == 0
    straight = next((tmp_path / "straight" / "tiny").iterdir())
    stopped = tmp_path / "stopped" / "tiny" / straight.name
    process = start(*words("stopped"), env=hold.environment)
    hold.wait(process, workers=2)
    os.kill(process.pid, signal.SIGINT)
    _, message = process.communicate(timeout=HANGS)
    assert process.returncode == 130
    assert "every finished epoch is saved. The same command continues" in message
    assert not list(stopped.glob("seed-*/epochs.parquet"))
    assert qrlsuite(*words("stopped")).returncode == 0
    for seed in range(3):
        assert results(straight, seed) == results(stopped, seed)


def test_seeds_that_another_process_trains_are_left_to_it(task: str, tmp_path: Path, hold: Hold) -> None:
    runs = str(tmp_path / "runs")
    words = ["run", "--task", task, "--model", "mlp", "--set", "width=16", "--runs", runs]
    first = start(*words, "--seeds", "0:2", "--workers", "1", env=hold.environment)
    hold.wait(first)
    other = qrlsuite(*words, "--seeds", "3", "--epochs", "2")
    assert other.returncode == 0, other.stderr
    assert "2 seeds are being trained by process" in other.stderr
    assert f" on {socket.gethostname()}; repeat this command" in other.stderr
    same = qrlsuite(*words, "--seeds", "0:2")
    assert (same.returncode, "nothing is left to do here" in same.stderr) == (0, True), same.stderr
    assert re.search(r"running +seeds 0:2  epoch \d/3  .*process", same.stderr), same.stderr
    assert "0 seeds complete" not in same.stderr
    hold.release()
    assert first.wait(HANGS) == 0


def test_a_budget_stops_a_run_as_ctrl_c_does(task: str, tmp_path: Path) -> None:
    words = ["run", "--task", task, "--model", "mlp", "--set", "width=16", "--seeds", "1", "--workers", "1"]
    runs = ["--runs", str(tmp_path / "runs")]
    done = qrlsuite(*words, *runs, "--epochs", "1000000", "--budget", "1.2s")
    assert done.returncode == 0, done.stderr
    assert "stopped after 1.2s, at epoch " in done.stderr
    assert "The same command continues from there" in " ".join(done.stderr.split())
    (entry,) = (tmp_path / "runs" / "tiny").iterdir()
    assert EntryStore(entry).finished([0], 1_000_000) == set()
    assert {header.epoch for header in checkpoint.headers(EntryStore(entry))} <= {most_epochs(entry)}
    epochs = most_epochs(entry) + 1
    for folder in (tmp_path / "runs", tmp_path / "straight"):
        assert qrlsuite(*words, "--runs", str(folder), "--epochs", str(epochs)).returncode == 0
    assert results(entry, 0) == results(tmp_path / "straight" / "tiny" / entry.name, 0)


def test_what_comes_next_works_as_it_is_printed(task: str, tmp_path: Path) -> None:
    """In a folder whose name needs quoting, with the environment active and without."""
    folder = tmp_path / "my results"
    folder.mkdir()
    words = ["run", "--task", task, "--model", "mlp", "--set", "width=16", "--seeds", "1", "--epochs", "1"]
    own = Path(sys.executable).parent
    without = os.pathsep.join(p for p in os.environ["PATH"].split(os.pathsep) if p != str(own))
    printed = []
    for path, program in ((os.environ["PATH"], "qrlsuite"), (without, str(own / "qrlsuite"))):
        env = {**os.environ, "PATH": path}
        done = qrlsuite(*words, "--runs", str(folder), env=env, cwd=tmp_path)
        lines = [
            line.removeprefix("next: ") for line in done.stderr.splitlines() if line.startswith("next: ")
        ]
        assert [shlex.split(line)[0] for line in lines] == [program, program]
        printed.append([shlex.split(line)[1:] for line in lines])
        for line in lines:
            assert shutil.which(shlex.split(line)[0], path=path), "the shell finds the command"
            typed = subprocess.run(
                f"printf '%s\\0' {line}", shell=True, check=True, capture_output=True, text=True
            )
            done = qrlsuite(*typed.stdout.split("\0")[1:-1], env=env, cwd=tmp_path)
            assert done.returncode == 0, done.stderr
    assert printed[0] == printed[1]
    assert list(folder.glob("*.png"))


def test_two_of_help_and_one_of_many(task: str) -> None:
    for words in (["-h"], ["run", "-h"], ["study", "run", "-h"]):
        done = qrlsuite(*words)
        assert (done.returncode, "Usage: qrlsuite" in done.stdout) == (0, True), done.stderr
    assert "linear combination" in qrlsuite("show", "vqc-qiskit").stdout


BROKEN = """
from qrlsuite import hookimpl
from qrlsuite.specs import ModelSpec

def build(observations, actions, options, generator):
    raise ZeroDivisionError("no width")

@hookimpl
def register_models(register):
    options = "qrlsuite.plugins.models.mlp:MLPOptions"
    register(ModelSpec("breaks", "Cannot be built", "classical", options, "broken_model:build"))
"""


def test_what_cannot_be_built_is_one_message_and_leaves_no_folder(task: str, tmp_path: Path) -> None:
    site = tmp_path / "site"
    site.mkdir()
    install(site, "broken_model", BROKEN)
    runs = ["--runs", str(tmp_path / "runs")]
    for words, message in (
        (
            ["--model", "breaks"],
            "model 'breaks' of broken_model cannot be built: ZeroDivisionError: no width (",
        ),
        (["--model", "mlp", "--device", "cuda:99"], "device = 'cuda:99'"),
        (["--model", "vqc-pennylane", "--set", "device=default.qubitt"], "did you mean 'default.qubit'?"),
    ):
        done = qrlsuite("run", "--task", task, *words, *runs, "--seeds", "2", env=installed(site))
        assert done.returncode == 2, done.stderr
        lines = [line for line in done.stderr.splitlines() if line.startswith("qrlsuite: ")]
        assert len(lines) == 1, done.stderr
        (line,) = lines
        assert message in line
        assert "Traceback" not in done.stderr
        assert "times" not in line
        assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "--task", "beam6g", "--model", "mlp", "--budget", "-1"], "--budget -1: write 90s, 30min"),
        (["run", "--task", "beam6h", "--model", "mlp"], "unknown task 'beam6h'; did you mean 'beam6g'"),
        (["run", "--task", "beam6g", "--model", "mpl"], "unknown model 'mpl'; did you mean 'mlp'"),
        (
            ["run", "--task", "beam6g", "--model", "iqp"],
            "unknown model 'iqp': it is an ansatz, which a circuit takes: --model vqc-native --set ansatz=iqp",
        ),
        (["run", "dqn mlp", "--task", "beam6g"], "did you mean 'ddqn'"),
        (["run", "--task", "beam6g"], "name a model, for example: qrlsuite run mlp width=16 --task beam6g"),
        (["run", "ppo", "mlp", "--model", "mlp", "--task", "beam6g"], "'ppo mlp' and --model mlp: give one"),
        (["run", "--task", "beam6g", "--model", "mlp", "--set", "widht=1"], "did you mean 'width'"),
        (["run", "--task", "beam6g", "--model", "mlp", "--set", "width=wide"], "width = 'wide'"),
        (["run", "--task", "beam6g", "mlp", "preset=relesed"], "did you mean 'released'"),
        (
            ["run", "--task", "beam6g", "--model", "mlp", "--seeds", "a:b"],
            "write a number (100), a range (0:20)",
        ),
        (["run", "--task", "no/such.toml", "--model", "mlp"], "cannot be read"),
        (
            ["run", "--task", "beam6g", "--model", "mlp", "--set", "environment.antennas=[[[1,1],[1,0]]]"],
            "antennas",
        ),
        (["run", "--task", "beam6g", "--model", "mlp", "--set", "degree=1"], "degree = 1"),
        (
            ["run", "--task", "beam6g", "--model", "mlp", "--set", "antennas=[[[1,1],[1,0]],[[9,1],[1,0]]]"],
            "antennas",
        ),
        (
            ["run", "--task", "beam6g", "--model", "mlp", "--set", "antennas=[[[1,1],[1,0]],[[3,1],[0,0]]]"],
            "orientation",
        ),
        (["run", "--task", "beam6g", "--model", "mlp", "--device", "cudda"], "give cpu, cuda, or one GPU"),
        (["run", "--task", "beam6g", "--model", "vqc-native", "--set", "qubits=0"], "qubits = 0"),
        (["run", "--task", "beam6g", "--model", "vqc-native", "--set", "qubits=21"], "qubits = 21"),
        (["run", "--task", "beam6g", "--model", "vqc-native", "--set", "qubits=1"], "needs 2 to 20"),
        (["run", "--task", "beam6g", "--model", "vqc-native", "--set", "gate=rott"], "gate = 'rott'"),
        (
            ["run", "--task", "beam6g", "--model", "vqc-native", "--set", "ansatz=ipq"],
            "unknown ansatz 'ipq'; did you mean 'iqp'",
        ),
        (["show", "ansatz", "iqp", "qubits=21"], "qubits = 21: a circuit has 1 to 20 qubits"),
        (
            ["run", "--task", "beam6g", "--model", "mlp", "--set", "lr=inf"],
            "lr = inf: infinite numbers cannot",
        ),
        (["run", "--task", "beam6g", "--model", "mlp", "--seeds", "9" * 12], "100000 seeds are the most"),
        (["run", "--task", "beam6g", "--model", "mlp", "--sedes", "3"], "--seeds"),
        (["run", "--task", "beam6g", "--model", "mlp", "--epochs", "0"], "--epochs"),
        (["rnu"], "Did you mean 'run'"),
        (["show", "ansatz", "iqp", "--out", "iqp.jpeg2"], "must be .png, .pdf or .svg"),
        (["list", "modles"], "did you mean 'models'"),
        (["show", "mpl"], "did you mean 'mlp'"),
        (["leaderboard", "--runs", "nowhere"], "there is no results folder nowhere"),
        *[
            ([*words, "--task", "beam6h", "--runs", "."], "unknown task 'beam6h'; did you mean 'beam6g'")
            for words in (
                ["leaderboard"],
                ["runs"],
                ["runs", "gc"],
                ["plot", "curves"],
            )
        ],
        (["runs", "--task", "/etc"], "unknown task '/etc'"),
        (["run", "--task", "beam6g", "mlp", "--minutes", "3"], "--minutes is gone: --budget 30min"),
        (["run", "--task", "beam6g", "mlp", "--preset", "x"], "--preset is gone: write it into the entry"),
        (["study", "run", "fig6", "--partition", "x"], "--partition is gone: --engine 'slurm partition=gpu"),
        (["tune", "--task", "beam6g", "--model", "mlp"], "--model is gone: write it into the entry"),
        (
            ["evaluate", "mlp", "--backend-set", "shots=3"],
            "--backend-set is gone: --backend 'qiskit shots=1000'",
        ),
        (
            ["study", "run", "fig6", "--set", "qubits=6"],
            "--set is gone: write it after the name, as in `qrlsuite study run",
        ),
        (["plot", "bars", "--settings"], "--settings is gone: qrlsuite show picture KIND"),
        (["show", "ansatz", "iqp", "--qubits", "4"], "--qubits is gone: write it after the name"),
        (["verify", "--choice", "3"], "--choice is gone: --rerun '2 choice=31'"),
        (["verify", "--rerun", "2 choise=3"], "--rerun 2 choise=3: write a number of seeds"),
        (["verify", "--rerun", "2 choice=x"], "choice is a whole number, which an earlier check printed"),
        (["export", "--all"], "--all is gone: qrlsuite export all"),
        (["export"], "name the entries to export, or say `export all`"),
        (["show", "picture", "barz"], "nothing called 'barz'; did you mean 'bars'"),
        (["show", "ansatz", "iqp", "cx"], "ansatz iqp cx: give one name"),
        (["plot", "bars", "wide"], "wide: write settings of the picture as NAME=VALUE"),
        (
            ["study", "run", "fig6", "vqc-native=vqc-nativ"],
            "unknown model 'vqc-nativ'; did you mean 'vqc-native'",
        ),
        (["status"], "`qrlsuite status` is now `qrlsuite runs`"),
        (["leaderboard", "verify", "."], "`qrlsuite leaderboard verify` is now `qrlsuite verify`"),
        (["calibrate"], "`qrlsuite calibrate` is now `python benchmarks/calibration.py`"),
        (["plot", "estimator", "--task", "beam6g"], "picture 'estimator' shows no results: leave --task out"),
        (["plot", "curves"], "`qrlsuite leaderboard --published` shows what comes with the suite"),
        (
            ["show", "mlp", "width=4"],
            "model 'mlp': NAME=VALUE, --out and --format draw an ansatz",
        ),
        (["leaderboard", "--format", "markdwn"], "'markdwn' is not one of"),
        (["plot", "curvs"], "unknown picture 'curvs'; did you mean 'curves'"),
    ],
)
def test_wrong_input_gives_one_clear_line_and_exit_code_2(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["qrlsuite", *words])
    with pytest.raises(SystemExit) as stopped:
        main()
    printed = capsys.readouterr()
    assert stopped.value.code == 2
    assert message in printed.err
    assert len(printed.err.strip().splitlines()) == 1, printed.err
    assert printed.out == ""
    assert list(tmp_path.iterdir()) == [], "wrong input leaves nothing behind"


def test_a_family_of_names_is_one_line_of_all_and_a_line_each_of_its_kind() -> None:
    lines, tasks = (qrlsuite("list", *words).stdout.splitlines() for words in ([], ["tasks"]))
    variants = [line for line in tasks if line.startswith("  beam6g-")]
    [folded] = [line for line in lines if line.startswith("  beam6g-")]
    assert folded.split(maxsplit=1) == [
        "beam6g-*",
        f"{len(variants)} variants of beam6g: qrlsuite list tasks",
    ]
    kinds = [line for line in lines if line and not line.startswith(" ")]
    assert len(kinds) == len(set(kinds)), "a kind is one block"


def test_list_and_show_answer_for_everything(tmp_path: Path) -> None:
    rows = json.loads(qrlsuite("list", "--json").stdout)
    assert {"environments", "models", "algorithms", "tasks"} <= {row["kind"] for row in rows}
    assert all(row["distribution"] for row in rows)
    shown = qrlsuite("show", "mlp").stdout
    assert "width = 64" in shown
    assert "units of each hidden layer" in shown
    protocol = json.loads(qrlsuite("show", "task", "beam6g", "--json").stdout)["protocol"]
    assert protocol["interactions"] == 2000
    ansatz = ("show", "ansatz", "cx", "qubits=3", "gate=u3")
    found = json.loads(qrlsuite(*ansatz, "--out", str(tmp_path / "cx.svg"), "--json").stdout)
    assert found["resources"]["gates"] == {"H": 3, "U3": 6, "CNOT": 3}
    assert "q_2: ┤ H ├┤ U3 ├" in found["drawing"]
    assert "two_qubit_depth: 3" in qrlsuite(*ansatz).stdout
    assert (tmp_path / "cx.svg").read_text().startswith("<?xml")
    for words in (("list", "hooks"), ("show", "hook", "register_models"), ("list", "significance-tests")):
        refused = qrlsuite(*words)
        assert refused.returncode == 2
        answer = "`rules`" if words[1] == "significance-tests" else "documentation: docs/api/hooks.md"
        assert refused.stderr == f"qrlsuite: '{words[1]}' is now {answer}\n"


def test_show_says_how_a_published_entry_was_made() -> None:
    name = ("show", "cartpole/reinforce mlp", "--published")
    shown = json.loads(qrlsuite(*name, "--json").stdout)
    assert (shown["seeds"], shown["parameters"]["classical"]) == (100, 114)
    assert shown["provenance"][0]["versions"]["qrlsuite"] == "0.1.0"
    assert json.loads(qrlsuite(*name, "--identity", "--json").stdout)["seeds"] == {"0:100": ["not recorded"]}


def test_version_and_help() -> None:
    assert qrlsuite("--version").stdout.startswith("qrlsuite ")
    for command in ("run", "leaderboard", "compare", "plot", "list", "show"):
        assert "Example" in qrlsuite(command, "--help").stdout


def test_workers_do_not_import_from_the_folder_one_stands_in(task: str, tmp_path: Path) -> None:
    """A source tree, or any folder called qrlsuite, may lie where the command is typed."""
    (tmp_path / "qrlsuite").mkdir()
    (tmp_path / "qrlsuite" / "__init__.py").write_text("raise ImportError('the wrong qrlsuite')")
    command = [str(Path(sys.executable).parent / "qrlsuite"), "run", "--task", task, "--model", "mlp"]
    command += ["--set", "width=16", "--seeds", "1", "--epochs", "1"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
