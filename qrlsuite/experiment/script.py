"""Scripts as entries: a command that trains one seed of any program, and the file where that writes its learning curve.

Nothing here starts a command. `qrlsuite.engine.script` does, for an entry whose `folder` is set: the command was typed
in this call, or stands in the study file that this call names. An entry that is read from a results folder has none.
"""

from __future__ import annotations

import fnmatch
import functools
import glob
import os
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass

from qrlsuite import options, specs
from qrlsuite.errors import OptionError, PluginError, UnknownNameError
from qrlsuite.experiment import source, task
from qrlsuite.experiment.task import EXTERNAL, Scale, Task

SCRIPT = "script"
"""Name of the algorithm of entries that a command trains."""

VALIDATION = "validation"
"""The kind of scores of the suite's own entries: means of fresh episodes without exploration, after every epoch."""

POINTS = 100
"""Epochs of a run on a task that the suite does not know."""

OF_TASKS = ("maximum", "thresholds", "every", "goal")
"""Options that define a task that the suite does not know."""


def _of_a_seed(text: str) -> str:
    shlex.split(text)  # a quote may be open
    if "{seed}" not in text:
        raise ValueError("write {seed} where the seed belongs, as in 'python ppo.py --seed {seed}'")
    return text


OfSeed = Annotated[str, AfterValidator(_of_a_seed), Field(max_length=10_000)]


@dataclass(frozen=True, kw_only=True, config={"extra": "forbid"})
class Script(Scale):
    """Options of a script's entry; the options of `Scale` define a task that the suite does not know.

    Attributes
    ----------
    command:
        Started without a shell; `{seed}` and `{steps}` are filled in.
    steps:
        Environment steps of a run; by default the task's protocol.
    curve:
        Pattern of the files with a run's curve: csv, or a file of `qrlsuite.results.run_files`.
    kind:
        What a score is, see `scores`.
    """

    command: OfSeed
    steps: Annotated[int | None, Field(ge=1)] = None
    curve: OfSeed = "runs/*__{seed}__*/*tfevents*"
    kind: Annotated[str | None, Field(pattern=specs.WHOLE_NAME, max_length=40)] = None

    def words(self, seed: int) -> list[str]:
        """Return the command's words for a seed."""
        return [self._filled(word, seed) for word in shlex.split(self.command)]

    def _filled(self, text: str, seed: object) -> str:
        return text.replace("{seed}", str(seed)).replace("{steps}", str(self.steps))

    def files(self, seed: int, folder: Path) -> list[Path]:
        """Return the files that a seed's pattern names now; `1` is not found in `10`."""
        names = glob.glob(self._filled(self.curve, seed), root_dir=folder, recursive=True)
        for part in (part for part in self.curve.split("/") if "{seed}" in part):
            alone = fnmatch.translate(self._filled(part, "\0")).replace("\0", rf"(?<!\d){seed}(?!\d)")
            names = [name for name in names if any(re.fullmatch(alone, word) for word in name.split("/"))]
        return [folder / name for name in sorted(names)]

    @property
    def scores(self) -> str:
        """The stated kind of the scores, else the kind that their name or the file's name implies."""
        files = {".npz": "eval/", "monitor.csv": "rollout/"}
        own = next((name for end, name in files.items() if self.curve.endswith(end)), "")
        return self.kind or kind_of(self.metric or own)


def kind_of(metric: str) -> str:
    """Return what scores of a name are: SB3's mean over 100 episodes, say, is compared with no single returns."""
    if metric.startswith(("eval/", "validation/")):
        return "evaluation"
    return "training-mean" if metric.startswith("rollout/") else "training"


def build(name: str, values: Mapping[str, Any]) -> Script:
    """Return the options of the script of a name."""
    if "command" not in values:
        example = f'{SCRIPT} {name} command="python {name}.py --seed {{seed}} --total-timesteps {{steps}}"'
        raise OptionError(f"script '{name}' needs its command here, for example: {example}")
    script: Script = options.build(Script, values, f"script '{name}'")
    return script


def parts(name: str) -> tuple[specs.AlgorithmSpec, specs.ModelSpec]:
    """Return specs that stand for a script's algorithm and model."""
    try:
        model = specs.ModelSpec(name, "A script", "classical", "qrlsuite.experiment.task:Nothing", "")
    except PluginError as error:
        raise OptionError(str(error)) from None
    return specs.AlgorithmSpec(SCRIPT, "A command that trains one seed", f"{__name__}:Script", ""), model


def place(name: str | Task, script: Script) -> tuple[Task, Script]:
    """Return the task of a script's scores, and the script with all of its steps.

    Scores of another kind than the task's own make another task, `cartpole+training`: nothing compares the two.
    """
    given = [option for option in OF_TASKS if getattr(script, option) is not None]
    if isinstance(name, Task):
        found = name
    elif given and not task.is_known(name):
        if script.steps is None:
            raise OptionError(f"task '{name}' is new: say how long a run is with steps=N")
        every = script.every or max(1, script.steps // POINTS)
        found = Task(task.external(name, script, every, script.steps // every), name)
    else:
        try:
            found = task.load(name)
        except UnknownNameError as error:
            new = "a new one needs steps=N, and maximum=BEST or thresholds=A,B"
            raise UnknownNameError(f"{error}; {new}") from None
    if given and found.environment.name != EXTERNAL:
        raise OptionError(f"{', '.join(given)}: task '{found.name}' says that itself; leave it out")
    protocol = found.file.protocol
    steps = script.steps or protocol.epochs * protocol.interactions
    if steps % protocol.interactions:
        epoch = f"epochs of {protocol.interactions} steps, as task '{found.name}' has them"
        raise OptionError(f"steps={steps}: not a whole number of {epoch}")
    kind = script.scores
    return found if kind == VALIDATION else found.with_scores(kind), replace(script, steps=steps)


def code(name: str, script: Script, folder: Path) -> dict[str, Any]:
    """Return the part of a code identity: every file that the command names, and what a script imports beside itself.

    Parameters
    ----------
    folder:
        Where the command is started.
    """
    files: dict[str, str] = {}
    for word, path in _named(shlex.split(script.command), folder):
        files[word] = source.digest(path.name, path.read_bytes())
        if path.suffix == ".py":
            root = path.parent if word in script.command else folder  # of `-m package.module`
            above = Path(word).parent if root == path.parent else Path()
            module = path.relative_to(root).with_suffix("").as_posix().replace("/", ".")
            files |= {(above / file).as_posix(): sha for file, sha in _imported(module, root).items()}
    return {"role": SCRIPT, "name": name, "distribution": name, "files": dict(sorted(files.items()))}


def _named(words: Sequence[str], folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield the files that a command names: as a word, behind `=`, or as a module behind `-m`."""
    for before, word in zip(["", *words], words):
        texts = [word, word.partition("=")[2]]
        if before == "-m":
            texts += [f"{word.replace('.', '/')}{end}" for end in (".py", "/__main__.py")]
        for text in filter(None, texts):
            path = folder / text
            # a program that is no text is an interpreter, which the machine has, as it has packages
            # (`Path.is_file` raises where a word is longer than a file's name can be)
            if os.path.isfile(path) and (before or path.suffix == ".py" or path.read_bytes()[:2] == b"#!"):
                yield text, path


def _imported(module: str, root: Path) -> dict[str, str]:
    """Return the SHA-256 of the files below a folder that a module imports, by path; nothing is executed."""
    found = source.reached([module], None, functools.partial(source.below, root))
    packages = {parent / "__init__.py" for file in found for parent in Path(file).parents if parent != Path()}
    here = [file for file in packages if (root / file).is_file()]
    return found | {file.as_posix(): source.digest(file.name, (root / file).read_bytes()) for file in here}
