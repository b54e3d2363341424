"""Code identity: the content of the code that computes an entry's numbers, while names may stand for other code.

    part                      content of its identity
    of the suite itself       its `numerics`, which is raised when its bits change; not its source
    a circuit                 its description, as built: gates, wires, angles, parameters (`canonical`)
    a plugin's other parts    the syntax trees of the modules that its code reaches by imports within its distribution;
                              of an environment, the distribution's data as well
    their plugin              all other files that it installs, or that belong to the plugin by path
    a file that an option     its bytes
    names
    a script                  every file that its command names, and what a Python script imports beside itself

The parts as canonical JSON give the digest, 16 hexadecimal digits of SHA-256. Engines, trackers and rules compute
nothing of an entry. Tests and documents of a package are no part of it.
"""

from __future__ import annotations

import functools
import hashlib
import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

from qrlsuite import circuit, options, own, registry, specs
from qrlsuite.circuit.description import Circuit, canonical
from qrlsuite.experiment import script as scripts
from qrlsuite.experiment import source
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.task import digest

OURS = "qrlsuite"
_CODE = {
    "environment": ("options", "entry_point", "vector"),
    "model": ("options", "build", "population"),
    "algorithm": ("options", "factory"),
    "backend": ("options", "factory"),
    "ansatz": ("options", "build"),
}
"""The references of a spec to code that computes, by role."""

Part = Mapping[str, Any]


@dataclass(frozen=True)
class CodeIdentity:
    """The parts that compute an entry's numbers.

    Attributes
    ----------
    parts:
        Each has a `role`, a `name`, a `distribution` (except files), and one of: `numerics`, the SHA-256 of a
        `circuit`, a SHA-256 for each of some `files`, or its own `sha256`.
    """

    parts: tuple[Part, ...]

    @property
    def text(self) -> str:
        """Content of the digest: canonical JSON."""
        return json.dumps(self.parts, sort_keys=True, separators=(",", ":"))

    @property
    def digest(self) -> str:
        """Sixteen hexadecimal digits."""
        return digest(self.parts)

    @property
    def original(self) -> bool:
        """Whether all code is the suite's, with its first bits, as of seeds without a recorded identity."""
        return all(
            part.get("distribution") == OURS and part.get("numerics", 1) == 1
            for part in self.parts
            if "distribution" in part
        )

    def record(self) -> dict[str, Any]:
        """Return the record in `run.json`."""
        return {"digest": self.digest, "parts": [dict(part) for part in self.parts]}


def of(entry: Entry) -> CodeIdentity:
    """Compute an entry's code identity from the installed code; a script's from where its command is started."""
    if entry.script is not None:
        folder = entry.folder
        return CodeIdentity(() if folder is None else (scripts.code(entry.model.name, entry.script, folder),))
    parts = [
        _part(role, each, circuit_of(entry) if role == "ansatz" else None, _environment_id(entry, role))
        for role, each in entry.registered().items()
    ]
    return CodeIdentity((*parts, *_packages(entry, parts), *_files(entry)))


def plugins(entry: Entry) -> list[own.Source]:
    """Return the plugins by path whose code makes an entry's numbers, or watches its training."""
    roots = [root for role, each in entry.registered().items() for root in _roots(role, each)]
    made = _environment_id(entry, "environment")
    if made is not None and (module := _gymnasium_module(made)) is not None:
        roots.append(module)
    needed = _by_path(roots)
    watching = {each.distribution for each in registry.load().of(specs.TrackerSpec).values()}
    return [each.source for each in own.loaded() if each.source in needed or each.source.name in watching]


def plugin_words(entry: Entry) -> list[str]:
    """Return the words of a command line that load an entry's plugins: `--plugin ring.py`."""
    return [word for each in plugins(entry) for word in ("--plugin", str(each.path))]


def _roots(role: str, each: registry.Registered[specs.NumericSpec]) -> list[str]:
    references = [getattr(each.spec, name) for name in _CODE[role]]
    return [reference.partition(":")[0] for reference in references if reference is not None]


def _by_path(roots: Iterable[str]) -> list[own.Source]:
    """Return the plugins by path that modules reach: one may import another."""
    reached = source.reached(roots, lambda name, spec: name in own.modules())
    needed = {Path(file).parts[0].removesuffix(".py") for file in reached}
    return [each.source for each in own.loaded() if each.source.module in needed]


def numerics(entry: Entry) -> dict[str, int]:
    """Return the `numerics` of an entry's parts that are the suite's own, by role."""
    return {
        role: each.spec.numerics for role, each in entry.registered().items() if each.distribution == OURS
    }


def circuit_of(entry: Entry) -> Circuit | None:
    """Build the circuit that a model's options describe; None where they describe none that can be built."""
    values = entry.model_options
    try:
        chosen = dict(getattr(values, "ansatz_options", {}))
        names = options.field_names(specs.resolve(registry.get(specs.AnsatzSpec, values.ansatz).options))
        for name in getattr(values, "passes_on", ()):
            if name in names:
                chosen.setdefault(name, getattr(values, name))
        return circuit.ansatz(values.ansatz, values.qubits, values.layers, **chosen)
    except Exception:  # a stranger's builder, of which training says in better words what is wrong
        return None


def of_registered(kind: type[specs.NumericSpec], name: str, drawn: Circuit | None = None) -> Part:
    """Return the part of a registered thing.

    Parameters
    ----------
    drawn:
        Of an ansatz: the circuit that it builds.
    """
    role = "backend" if kind is specs.CircuitBackendSpec else kind.kind
    return _part(role, registry.load().get(kind, name), drawn, None)


def _part(
    role: str, each: registry.Registered[specs.NumericSpec], drawn: Circuit | None, gym: str | None
) -> Part:
    part: dict[str, Any] = {"role": role, "name": each.spec.name, "distribution": each.distribution}
    if each.distribution == OURS:
        part["numerics"] = each.spec.numerics
    if drawn is not None:
        return {**part, "circuit": hashlib.sha256(canonical(drawn).encode()).hexdigest()}
    if gym is not None and (module := _gymnasium_module(gym)) is not None:
        owner = metadata.packages_distributions().get(module.partition(".")[0], ["unknown"])[0]
        return {"role": role, "name": gym, "distribution": owner, "files": _modules([module], owner)}
    if each.distribution != OURS:
        roots = _roots(role, each)
        files = _modules(roots, each.distribution)
        if role == "environment":  # scores of another game cannot be compared
            of_package = _installed(roots, each.distribution)
            files |= {file: code for file, code in of_package.items() if not file.endswith(".py")}
        part["files"] = dict(sorted(files.items()))
    return part


def _packages(entry: Entry, parts: Sequence[Part]) -> Iterator[Part]:
    """Yield, of every plugin whose code computes, a part with the files that are in none of the others."""
    roots: dict[str, list[str]] = {}
    for (role, each), part in zip(entry.registered().items(), parts, strict=True):
        if "files" in part and each.distribution != OURS:
            roots.setdefault(each.distribution, []).extend(_roots(role, each))
    covered = {file for part in parts for file in part.get("files", ())}
    for distribution, modules in roots.items():
        of_package = _installed(modules, distribution)
        if files := {file: code for file, code in of_package.items() if file not in covered}:
            yield {"role": "plugin", "name": distribution, "distribution": distribution, "files": files}


def _environment_id(entry: Entry, role: str) -> str | None:
    """Return the id under which Gymnasium makes an entry's environment, where no spec has its code."""
    spec = entry.task.environment
    if role != "environment" or spec.entry_point is not None:
        return None
    if spec.vector is None:
        return spec.gymnasium_id
    return entry.task.environment_options.id if spec.name == "gym" else None


def _gymnasium_module(env_id: str) -> str | None:
    """Return the module of an environment that another package than Gymnasium registered there."""
    gymnasium = sys.modules.get("gymnasium")
    known = None if gymnasium is None else gymnasium.registry.get(env_id.rpartition(":")[2])
    point = None if known is None else known.entry_point
    module = point.partition(":")[0] if isinstance(point, str) else getattr(point, "__module__", None)
    return None if module is None or module.partition(".")[0] in ("gymnasium", OURS) else module


def _modules(roots: Sequence[str], distribution: str) -> dict[str, str]:
    """Return the modules that roots reach within their distribution; without one, within their own folder."""
    tops = {root.partition(".")[0] for root in roots}
    if own.of_distribution(distribution) is not None:
        paths = own.modules()
        return source.reached(roots, lambda name, spec: name in paths)
    listed = _listed(distribution)
    places = {_place(spec) for top in tops if (spec := source.find(top)) is not None} - {None}

    def belongs(name: str, spec: ModuleSpec) -> bool:
        return name in tops or (name in listed if listed else _place(spec) in places)

    return source.reached(roots, belongs)


def _installed(roots: Sequence[str], distribution: str) -> dict[str, str]:
    """Return all files that a plugin by path has, or that a distribution installs in its packages."""
    if own.of_distribution(distribution) is not None:
        files = {name: content for each in _by_path(roots) for name, content in each.files.items()}
        return {name: source.digest(name, files[name]) for name in sorted(files) if source.counts(name)}
    found: dict[str, str] = {}
    for top in {root.partition(".")[0] for root in roots} | _listed(distribution):
        spec = source.find(top)
        if spec is not None and spec.origin is not None and spec.submodule_search_locations is not None:
            folder = Path(spec.origin).parent
            names = {f"{top}/{path.relative_to(folder).as_posix()}": path for path in own.walk(folder)}
            for name in filter(source.counts, names):
                found[name] = _digest(names[name], names[name].stat().st_mtime_ns)
    return dict(sorted(found.items()))


@functools.cache
def _digest(path: Path, changed: int) -> str:
    """Return the SHA-256 of a file as it was last changed; a study asks for it many times."""
    return source.digest(path.name, path.read_bytes())


def _listed(distribution: str) -> set[str]:
    """Return the top-level modules that a distribution says that it has."""
    try:
        found = metadata.distribution(distribution)
    except (metadata.PackageNotFoundError, ValueError):
        return set()
    words = (found.read_text("top_level.txt") or "").split()
    files = [file for file in found.files or () if file.suffix == ".py"]
    names = {*words, *(file.parts[0].partition(".")[0] for file in files)}
    return {
        name for name in names if not name.startswith("__editable__")
    }  # which names a folder of this machine


def _place(spec: ModuleSpec) -> Path | None:
    """Return the folder in which a top-level module lies, None where packages of all origins do."""
    if spec.origin is None or not spec.has_location:
        return None
    path = Path(spec.origin).parent
    folder = path.parent if spec.submodule_search_locations is not None else path
    shared = folder.name in ("site-packages", "dist-packages") or (folder / "asyncio").is_dir()
    return None if shared else folder


def _files(entry: Entry) -> Iterator[Part]:
    """Yield a part for every option that names a file."""
    sides = {
        "environment": entry.task.environment_options,
        "algorithm": entry.algorithm_options,
        "model": entry.model_options,
    }
    for side, values in sides.items():
        for name, value in _texts(side, options.plain(values)):
            if ("/" in value or "." in value) and (content := _content(Path(value))) is not None:
                yield {"role": "file", "name": name, "sha256": content}


def _content(path: Path) -> str | None:
    try:
        if not path.is_file():
            return None
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, ValueError):  # a text that can be no path
        return None


def _texts(name: str, value: Any) -> Iterator[tuple[str, str]]:
    if isinstance(value, str):
        yield name, value
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _texts(f"{name}.{key}", inner)
    elif isinstance(value, list | tuple):
        for number, inner in enumerate(value):
            yield from _texts(f"{name}.{number}", inner)


def differences(before: Sequence[Part], now: Sequence[Part], numerics: bool = True) -> list[str]:
    """Return the differences between two identities in words; without `numerics`, bits may differ."""
    if not numerics:
        before, now = ([{**part, "numerics": 1} for part in parts] for parts in (before, now))
    old, new = ({(part["role"], part["name"]): part for part in parts} for parts in (before, now))
    changes: list[str] = []
    for key in dict.fromkeys([*old, *new]):
        changes += _changes(f"{key[0]} '{key[1]}'", old.get(key), new.get(key))
    return changes


def _changes(what: str, old: Part | None, new: Part | None) -> Iterator[str]:
    if old == new:
        return
    if new is None:
        yield f"{what} of {(old or {}).get('distribution')} is not registered here"
        return
    if old is None:
        yield f"{what} is new"
        return
    owner = new.get("distribution")
    if owner != old.get("distribution"):
        yield f"{what} is of {owner}, and was of {old.get('distribution')}"
    if old.get("numerics", 1) != new.get("numerics", 1):
        yield f"{what} has numerics {new.get('numerics', 1)}, and had {old.get('numerics', 1)}"
    if old.get("circuit") != new.get("circuit"):
        yield f"the circuit of {what} of {owner} has changed"
    if old.get("sha256") != new.get("sha256"):
        yield f"the {what} has another content"
    was, files = old.get("files", {}), new.get("files", {})
    for path in dict.fromkeys([*was, *files]):
        if was.get(path) != files.get(path):
            verb = "is new" if path not in was else "is gone" if path not in files else "has changed"
            yield f"{path} of {owner} ({what}) {verb}"
