"""The command line as a user meets it: a process, its output, its exit codes."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from qrlsuite import own
from qrlsuite.cli import main
from qrlsuite.errors import UnknownNameError
from qrlsuite.results import checkpoint
from qrlsuite.results.store import EntryStore
from tests.commands import answer, qrlsuite, say, start
from tests.conftest import HANGS, TINY, Hold, cases, install, installed, most_epochs, results


@pytest.fixture
def task(tmp_path: Path) -> str:
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return str(path)


def test_a_run_says_where_entries_have_another_definition_of_its_task(task: str, tmp_path: Path) -> None:
    words = (
        "run",
        "mlp",
        "width=4",
        "--task",
        task,
        "--seeds",
        "1",
        "--epochs",
        "1",
        "--runs",
        str(tmp_path),
    )
    assert "another definition" not in qrlsuite(*words).stderr
    Path(task).write_text(TINY.replace("validation_episodes = ", "validation_episodes = 1"))
    assert "1 entry of another definition of task 'tiny' here: ddqn-mlp-" in qrlsuite(*words).stderr

    # the file's path asks for what it defines now, however many entries have another definition
    Path(task).write_text(TINY)
    qrlsuite(*words, "--set", "width=8")
    for text, ranked in ((TINY, 2), (TINY.replace("validation_episodes = ", "validation_episodes = 1"), 1)):
        Path(task).write_text(text)
        board = json.loads(qrlsuite("leaderboard", "--format", "json", "--task", task, *words[-2:]).stdout)
        assert {len(section["rows"]) for section in board["sections"]} == {ranked}
        assert len(board["refused"]) == 3 - ranked
        page = tmp_path / "board.html"
        qrlsuite("leaderboard", "--format", "html", "--out", str(page), "--task", task, *words[-2:])
        assert f"{ranked} entr{'y' if ranked == 1 else 'ies'} on 1 task" in page.read_text()


def test_run_then_leaderboard_compare_and_plot(task: str, tmp_path: Path) -> None:
    runs = str(tmp_path / "runs")
    for width in ("16", "8"):
        done = qrlsuite("run", "--task", task, "--model", "mlp", "--set", f"width={width}", "--runs", runs)
        assert done.returncode == 0, done.stderr
        assert "4 seeds complete" in done.stderr
        assert f"results: {runs}/" in done.stderr
        assert (f"results are in the new folder {runs};" in done.stderr) == (width == "16")
    words = ("run", "ddqn", "mlp", "width=16", "--task", task, "--runs", runs)
    assert json.loads(qrlsuite(*words, "--json").stdout)["seeds"] == 4
    assert "next: qrlsuite leaderboard --task tiny" in done.stderr
    tried = qrlsuite(
        "run", "ddqn", "mlp", "width=4", "--task", task, "--runs", runs, "--seeds", "1000000:1000001"
    )
    assert (
        "seeds from 1,000,000 up are for trying settings: boards and pictures leave them out" in tried.stderr
    )
    assert "next:" not in tried.stderr

    # a task file's path says which task, as its name does
    for text in ("leaderboard --format json", "runs --json", "compare 'mlp width=8' 'mlp width=16' --json"):
        by_path, by_name = (
            json.loads(say(*shlex.split(text), "--runs", runs, "--task", name).stdout)
            for name in (task, "tiny")
        )
        assert by_path == by_name
    assert "name: tiny\n" in say("show", task).stdout
    assert say("show", task, "--format", "toml").stdout == TINY

    assert "no rank below 20 seeds" in qrlsuite("leaderboard", "--runs", runs).stdout
    (section,) = json.loads(say("leaderboard", "--runs", runs, "--format", "json").stdout)["sections"]
    assert {row["label"] for row in section["rows"]} == {"ddqn mlp width=16", "ddqn mlp width=8"}
    assert all(row["tier"] is None and row["seeds"] == 4 for row in section["rows"])
    assert "| - | mlp width=8 |" in say("leaderboard", "--runs", runs, "--format", "markdown").stdout

    compared = qrlsuite("compare", "mlp width=16", "mlp width=8", "--runs", runs)
    assert "settings: default, not tuned" in compared.stdout
    with pytest.raises(UnknownNameError, match="'mlp width=4' has seeds from 1,000,000 up alone"):
        say("evaluate", "mlp width=4", "--runs", runs)
    say("plot", "curves", "--runs", runs, "--out", str(tmp_path / "c.svg"))
    assert (tmp_path / "c.svg").read_text().startswith("<?xml")

    (entry,) = (path for path in (tmp_path / "runs" / "tiny").iterdir() if "width=16" in label(path))
    before = results(entry, 0)
    wider = qrlsuite(*words, "--seeds", "5").stderr
    assert "1 seed to epoch 3" in wider
    assert "4 seeds already there" in wider
    assert results(entry, 0) == before
    assert EntryStore(entry).seeds() == [0, 1, 2, 3, 4]


def label(entry: Path) -> str:
    return EntryStore(entry).record().label


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


def test_a_trained_circuit_is_followed_by_a_network_of_its_size(task: str, tmp_path: Path) -> None:
    words = ["run", "vqc-native", "qubits=3", "gamma=.9", "quantum_lr=.01", "environment.degree=4"]
    words += ["--task", task, "--seeds", "1", "--epochs", "1", "--runs", str(tmp_path / "runs")]
    said, _, typed = qrlsuite(*words).stderr.splitlines()[-1].partition("): ")
    network, circuit = map(int, re.findall(r"\d+", said))
    assert 0.8 < network / circuit < 1.25
    assert "ddqn mlp width=" in typed
    assert "gamma=0.9" in typed
    assert qrlsuite(*shlex.split(typed)[1:]).returncode == 0
    (one,) = (tmp_path / "runs").iterdir()
    assert len(list(one.glob("ddqn-*"))) == 2, "both are on one task"
    assert "of its size" not in qrlsuite(*words).stderr, "nothing was trained"


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
    for model, message in (
        ("breaks", "model 'breaks' of broken_model cannot be built: ZeroDivisionError: no width ("),
        ("vqc-pennylane device=default.qubitt", "did you mean 'default.qubit'?"),  # as its worker finds out
    ):
        words = ["run", model, "--task", task, "--seeds", "2", "--runs", str(tmp_path / "runs")]
        done = qrlsuite(*words, env=installed(site))
        assert done.returncode == 2, done.stderr
        (line,) = [line for line in done.stderr.splitlines() if line.startswith("qrlsuite: ")]
        assert message in line
        assert "Traceback" not in done.stderr
        assert "times" not in line
        assert not (tmp_path / "runs").exists()


STUDY = 'format_version = 1\nname = "x"\nsummary = "x"\n[[pictures]]\n'
DEPLOYED = STUDY + 'kind = "deployed"\nevaluation.deployed = { backend = "B", vary = "V", values = [N] }\n'
PLUGIN = "def ring(qubits, layers): ...\n"
GIVEN = {
    "tiny.toml": TINY + "[protocol.algorithm_epochs]\nppo = 30\n",
    "bar.toml": STUDY + 'kind = "bar"\n',
    "many.toml": STUDY + 'kind = "curves"\nsettings = { horizon = "many" }\n',
    "mixed.toml": STUDY.partition("[[")[0]
    + "".join(
        f'[[entries]]\nname = "{task}"\ntask = "{task}"\nmodel = "mlp"\nalgorithm = "ddqn"\n'
        for task in ("cartpole", "pendulum")
    )
    + '[[pictures]]\nname = "x"\nkind = "curves"\n',
    "episodes.toml": STUDY + 'kind = "histogram"\n',
    "nowhere.toml": STUDY + 'kind = "deployed"\nevaluation = { episodes = 3 }\n',
    "backend.toml": DEPLOYED.replace("B", "nativ").replace("V", "shots").replace("N", "9"),
    "zero.toml": DEPLOYED.replace("B", "native").replace("V", "shots").replace("N", "9, 0"),
    "option.toml": DEPLOYED.replace("B", "native").replace("V", "shot").replace("N", "9"),
    "ring.py": PLUGIN,
    "again.py": PLUGIN,
    "part.py": "from ring import *\n\nclass Net(Base): ...\n",
    "b/ring.py": PLUGIN + "x = 1\n",
    "broken.py": "x = 1\nx / 0\n",
}
"""Files of the folder in which the wrong commands are typed."""
WRONG = """
rnu => Did you mean 'run'
run mlp --task beam6g --budget -1 => --budget -1: write 90s, 30min
run --task beam6h --model mlp => unknown task 'beam6h'; did you mean 'beam6g'
run --task no/such.toml --model mlp => cannot be read
run --task beam6g => name a model, for example: qrlsuite run mlp width=16 --task beam6g
run mpl --task beam6g => unknown model 'mpl'; did you mean 'mlp'
run --task beam6g --model iqp => it is an ansatz, which a circuit takes: --model vqc-native --set ansatz=iqp
run 'dqn mlp' --task beam6g => did you mean 'ddqn'
run ppo mlp --model mlp --task beam6g => 'ppo mlp' and --model mlp: give one
run mlp --task beam6g --set widht=1 => did you mean 'width'
run mlp --task beam6g --set width=wide => width = 'wide'
run mlp --task beam6g --set lr=inf => lr = inf: infinite numbers cannot
run mlp preset=relesed --task beam6g => did you mean 'released'
run mlp --task beam6g --seeds a:b => write a number (100), a range (0:20)
run mlp --task beam6g --seeds 999999999999 => 100000 seeds are the most
run mlp --task beam6g --sedes 3 => --seeds
run mlp --task beam6g --epochs 0 => --epochs
run mlp --task beam6g --device cudda => give cpu, cuda, or one GPU
run mlp --task beam6g --device cuda:99 => device = 'cuda:99'
run mlp --task beam6g --set degree=1 => degree = 1
run mlp --task beam6g --set environment.antennas=[[[1,1],[1,0]]] => antennas
run mlp --task beam6g --set antennas=[[[1,1],[1,0]],[[9,1],[1,0]]] => antennas
run mlp --task beam6g --set antennas=[[[1,1],[1,0]],[[3,1],[0,0]]] => orientation
run vqc-native qubits=0 --task beam6g => qubits = 0
run vqc-native qubits=21 --task beam6g => qubits = 21
run vqc-native qubits=1 --task beam6g => needs 2 to 20
run vqc-native gate=rott --task beam6g => gate = 'rott'
run vqc-native ansatz=ipq --task beam6g => unknown ansatz 'ipq'; did you mean 'iqp'
run 'ddqn mlp' --task pendulum => 'ddqn' takes discrete actions, and task 'pendulum' has Box(-2.0
run 'td3 mlp' --task cartpole => 'td3' takes box actions, and task 'cartpole' has Discrete(2): take one of
run mlp --task gym:tests.environments.strangers:Unbounded-v0 => has no bounds: state finite ones, gymnasium.spaces.Box
run 'ddqn gru' --task cartpole => model 'gru' remembers what it saw in an episode, and algorithm 'ddqn' would make it
run 'ddqn cnn' --task cartpole => model 'cnn' needs images, a Box of (height, width)
run vqc-native qubits=4 linear=false --task pendulum => the circuit has 4 inputs and 4 expectation values, the actor 3
study run mixed.toml => 'ddqn' takes discrete actions, and task 'pendulum' has Box(-2.0
list modles => did you mean 'models'
show mpl => did you mean 'mlp'
show mlp width=4 => model 'mlp': NAME=VALUE, --out and --format draw an ansatz
show picture barz => nothing called 'barz'; did you mean 'bars'
show ansatz iqp cx => ansatz iqp cx: give one name
show advantage-pulse --format json => study 'advantage-pulse' takes no NAME=VALUE, --format or --identity here; --json
show advantage-pulse advantage-cartpole --identity => several studies, without options, --format and --identity
show advantage-pulse width=3 => study 'advantage-pulse' takes no NAME=VALUE
show picture bars --format json => picture 'bars': NAME=VALUE, --out and --format draw an ansatz
show picture bars --identity => picture 'bars' computes nothing for an entry
show ansatz iqp --format qasm3 --out iqp.png => give one of --identity, --out and --format
runs --format csv --json => --format csv and --json: give one of them
diagnose ansatz iqp qubits=2 --task beam6g => --task changes nothing for an ansatz: leave it out
diagnose 'mlp width=64' --task beam6g --published --draws 50 => --draws changes nothing for entries
check --task beam6g => --task needs a name
leaderboard --task pulse --published --rule paper --alpha .2 => --alpha changes nothing in tiers by rule 'paper'
leaderboard --task pulse --published --format csv --explain => --explain changes nothing in csv
export advantage-pulse --force => a study with looks is written whole
power --like many.csv --published => --published changes nothing with --like
plot pairs --study advantage-pulse --task pulse => shows its looks as they are: leave settings, --task
plot trajectories --task beam6g --label 'mlp=x' => picture 'trajectories' shows no results: leave --label out
plot surface --task pulse --published elevation=50 => picture 'surface': elevation is for style=3d
study run fig6 mlp boats --dry-run => boats: study 'fig6' has no such entry
study run fig6 --dry-run --budget soon => --budget soon: write 90s, 30min
show ansatz iqp qubits=0 => qubits = 0: a circuit has 1 qubit or more
show ansatz iqp --out iqp.jpeg2 => must be .png, .pdf or .svg
run mlp --task tiny => task 'tiny' is not registered, but in a file: write --task tiny.toml
leaderboard --task tiny => in a file: write --task tiny.toml
run mlp --task gone => unknown task 'gone'
show task gone.toml --format toml => task file gone.toml cannot be read
leaderboard --task tiny.toml => there is no results folder runs
show bar.toml => pictures.0.kind: unknown picture 'bar'; did you mean 'bars'
show many.toml => many.toml: pictures.0.settings
show episodes.toml => pictures.0.evaluation: picture 'histogram' needs evaluation
show nowhere.toml => pictures.0.evaluation.deployed: picture 'deployed' needs deployed
show backend.toml => unknown circuit backend 'nativ'; did you mean 'native'
show zero.toml => pictures.0.evaluation.deployed: shots = 0
show option.toml => no option 'shot'; did you mean 'shots'
show quantum-or-no => 'quantum-or-no'; did you mean 'quantum-or-not'?
leaderboard --runs nowhere => there is no results folder nowhere
leaderboard --format markdwn => 'markdwn' is not one of
leaderboard --task beam6h --runs . => unknown task 'beam6h'; did you mean 'beam6g'
runs --task beam6h --runs . => unknown task 'beam6h'; did you mean 'beam6g'
runs --task /etc => unknown task '/etc'
runs gc --task beam6h --runs . => unknown task 'beam6h'; did you mean 'beam6g'
verify --rerun '2 choise=3' => --rerun 2 choise=3: write a number of seeds
verify --rerun '2 choice=x' => choice is a whole number, which an earlier check printed
export => name the entries to export, or say `export all`
plot curves => `qrlsuite leaderboard --published` shows the entries that come with the suite
plot curves --task beam6h --runs . => unknown task 'beam6h'; did you mean 'beam6g'
plot curvs => unknown picture 'curvs'; did you mean 'curves'
plot trajectory => did you mean 'trajectories'
plot trajectories => add --task TASK
plot field --task cartpole => shows tasks of beam6g; 'cartpole' is a task of cartpole
plot histogram => drawn by: qrlsuite evaluate ENTRY
plot bars wide => wide: write settings of the picture as NAME=VALUE
plot bars --out x.gif => must be .png, .pdf or .svg
tune width=4 --task tiny.toml => entry 'width=4': write [ALGORITHM] MODEL NAME=VALUE ...
tune mlp mlp --task tiny.toml --out p.toml => for one entry
tune mlp --task tiny.toml --vary papre => unknown grid 'papre'; did you mean 'paper'
tune mlp --task tiny.toml --vary =1 => write a name and its values
tune mlp --task tiny.toml --vary paper --vary x.toml => give one grid
tune mlp --task tiny.toml --vary lr=1,2 --seeds 0:20 => --seeds 0:20: tuning uses seeds from 1000000
tune mlp --task tiny.toml --vary lr=1,2 --budget soon => --budget soon: write 90s, 30min
tune mlp --task tiny.toml --vary lr=1,2 --out p.json => one file ending in .toml
tune mlp --task tiny.toml --sampler 'randm trials=3' => did you mean 'random'
tune mlp --task tiny.toml --sampler 'random trial=3' => did you mean 'trials'
study run fig66 => unknown study 'fig66'; did you mean 'fig6'
study run gone.toml => study file gone.toml cannot be read
study run fig6 --budget soon => write 90s, 30min, 8h
study run fig6 --engine lokal => did you mean 'local'
study run fig6 --seeds a:b => write a number (100)
study run fig6 vqc-native=vqc-nativ => unknown model 'vqc-nativ'; did you mean 'vqc-native'
study run fig6 nothing => study 'fig6' has no such entry
plot bars --study fig6 => study 'fig6' has no seeds yet: qrlsuite study run fig6
plot barz --study fig6 => study 'fig6' has no picture 'barz'; did you mean 'bars'
plot bars --study fig6 --entry mlp => --study fig6 names the entries
plot bars --study fig6 --study fig7 => picture 'bars' shows one study: leave fig7 out
plot histogram --study fig8 => drawn by: qrlsuite evaluate 'ddqn mlp width=64' 'ddqn vqc-native qubits=14' --task beam6g
plot deployed --study fig6 => needs a study whose file has an evaluation
plot shots --study deploy --seeds 3 => plays the best agents of all seeds here: leave --seeds
plot bars --study fig6 --task cartpole --runs . => study 'fig6' has no entry of task cartpole
plot entries --study memory --study quantum-or-not => picture 'entries' shows one study
study end fig6 => study 'fig6' has no looks
study new p.toml --task tiny.toml mlp => a study with looks needs two or more entries
study new p.toml --task tiny.toml mlp 'mlp width=4' 'ddqn mlp width=4' => entries.1 and entries.2 are the same
study new p.toml --task tiny.toml mlp mpl => unknown model 'mpl'; did you mean 'mlp'
study new p.toml --task tiny.toml mlp 'mlp widht=4' => did you mean 'width'
study new p.toml --task tiny.toml mlp 'width=4 mlp' => entry 'width=4 mlp'
study new p.toml --task tiny.toml mlp 'ppo mlp' => different horizons: 'ddqn mlp width=64' at 180 steps, 'ppo
study new p.toml --task tiny.toml mlp 'mlp width=4' --looks alpha=1 => alpha = 1.0 is outside (0, 1)
study new p.toml --task tiny.toml mlp 'mlp width=4' --looks 20,40,40 => each must be at more runs than the one before
study new p.toml --task tiny.toml mlp 'mlp width=4' --looks 10,20 => the first is below 20 runs
study new p.toml --task tiny.toml mlp 'mlp width=4' --looks '20;40' => --looks 20;40: write numbers of seeds
study new p.toml --task tiny.toml mlp 'mlp width=4' --looks '20,40 margin=0' => margin = 0.0 is not a positive number
study new p.toml --task tiny.toml mlp 'mlp width=4' --looks first_seed=3 => seeds 0:4 are the protocol's
study new p.toml --task tiny.toml mlp 'mlp width=4' --looks first_seed=999999 => from 1000000 up are for tuning
study new p.toml --task tiny.toml mlp 'mlp width=4' --looks '20 margn=1' => option 'margn'; did you mean 'margin'
study new p --task tiny.toml mlp 'mlp width=4' => p: a study file's name ends in .toml
study new 'p q.toml' --task tiny.toml mlp 'mlp width=4' => name
study new tiny.toml --task tiny.toml mlp 'mlp width=4' => tiny.toml is there already
new plugin acme-ring => name the plugin's file: --from ring.py
new plugin --from part.py => part.py imports ring.py: make a package's folder of both
new plugin --from none.py => there is no plugin none.py
new plugin --from ring.py Ring => 'Ring' cannot be the name of a package
list ansatzes --plugin => --plugin needs a path, for example --plugin ring.py
list ansatzes --plugin none.py => there is no plugin none.py
list ansatzes --plugin broken.py => broken.py:2: ZeroDivisionError: division by zero
list ansatzes --plugin ring.py --plugin b/ring.py => two plugins are called ring:
list ansatzes --plugin ring.py --plugin again.py => ansatz 'ring' is registered already, by ring.py (
list ansatzes --plugin b => plugin b is no package: it has no __init__.py
"""
"""What is typed, and what the one line of the answer has; answered with exit code 2."""
if find_spec("submitit"):
    WRONG += """\
run mlp --task beam6g --engine slurm --budget 1h => --budget: engine 'slurm' leaves its tasks in a queue
tune mlp --task beam6g --vary lr=.01,.02 --engine slurm --budget 1h => --budget: engine 'slurm' leaves its tasks
"""


@pytest.mark.parametrize(("typed", "message"), cases(WRONG))
def test_wrong_input_gives_one_clear_line_and_exit_code_2(
    typed: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "b").mkdir()
    for name, text in GIVEN.items():
        Path(name).write_text(text)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    monkeypatch.setattr(sys, "argv", ["qrlsuite", *shlex.split(typed)])
    try:
        with pytest.raises(SystemExit) as stopped:
            main()
    finally:
        for plugin in own.loaded():
            own.unload(plugin)
    printed = capsys.readouterr()
    said = [line for line in printed.err.strip().splitlines() if line != "ring.py: ansatz ring"]
    assert stopped.value.code == 2
    assert len(said) == 1, printed.err
    assert message in said[0]
    assert printed.out == ""
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before, "nothing is touched"


def test_a_family_of_names_is_one_line_of_all_and_a_line_each_of_its_kind() -> None:
    lines, tasks = (say("list", *words).stdout.splitlines() for words in ([], ["tasks"]))
    variants = [line for line in tasks if line.startswith("  beam6g-")]
    [folded] = [line for line in lines if line.startswith("  beam6g-")]
    assert folded.split(maxsplit=1) == [
        "beam6g-*",
        f"{len(variants)} variants of beam6g: qrlsuite list tasks",
    ]
    kinds = [line for line in lines if line and not line.startswith(" ")]
    assert len(kinds) == len(set(kinds)), "a kind is one block"


def test_list_and_show_answer_for_everything(tmp_path: Path) -> None:
    rows = answer("list")
    assert {"environments", "models", "algorithms", "tasks"} <= {row["kind"] for row in rows}
    assert all(row["distribution"] for row in rows)
    shown = say("show", "mlp").stdout
    assert "width = 64" in shown
    assert "units of each hidden layer" in shown
    assert "linear combination" in say("show", "vqc-qiskit").stdout
    assert answer("show", "task", "beam6g")["protocol"]["interactions"] == 2000
    ansatz = ("show", "ansatz", "cx", "qubits=3", "gate=u3")
    found = answer(*ansatz, "--out", str(tmp_path / "cx.svg"))
    assert found["resources"]["gates"] == {"H": 3, "U3": 6, "CNOT": 3}
    assert "q_2: ┤ H ├┤ U3 ├" in found["drawing"]
    assert "two_qubit_depth: 3" in say(*ansatz).stdout
    assert (tmp_path / "cx.svg").read_text().startswith("<?xml")


def test_show_says_how_a_published_entry_was_made() -> None:
    name = ("show", "cartpole/reinforce mlp", "--published")
    shown = answer(*name)
    assert (shown["seeds"], shown["parameters"]["classical"]) == (100, 114)
    assert shown["provenance"][0]["versions"]["qrlsuite"] == "0.1.1"
    assert answer("show", "ppo mlp width=64", "--published", "--identity")["seeds"] == {
        "0:20": ["not recorded"]
    }


def test_version_and_help() -> None:
    assert qrlsuite("--version").stdout.startswith("qrlsuite ")
    assert "Usage: qrlsuite" in qrlsuite("-h").stdout
    for command in ("run", "study run", "leaderboard", "compare", "plot", "list", "show"):
        said = say(*command.split(), "--help").stdout
        assert ("Example" in said, said) == (True, say(*command.split(), "-h").stdout)


def test_workers_do_not_import_from_the_folder_one_stands_in(task: str, tmp_path: Path) -> None:
    """A source tree, or any folder called qrlsuite, may lie where the command is typed."""
    (tmp_path / "qrlsuite").mkdir()
    (tmp_path / "qrlsuite" / "__init__.py").write_text("raise ImportError('the wrong qrlsuite')")
    command = [str(Path(sys.executable).parent / "qrlsuite"), "run", "--task", task, "--model", "mlp"]
    command += ["--set", "width=16", "--seeds", "1", "--epochs", "1"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
