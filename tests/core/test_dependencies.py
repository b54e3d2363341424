"""The arrows of the architecture, read from the imports, and the package list, read from the folders."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = {
    "qrlsuite": ROOT / "qrlsuite",
    "qrlsuite.plugins": ROOT / "plugins",
    "qrlsuite.tasks": ROOT / "tasks",
    "qrlsuite.leaderboard": ROOT / "leaderboard",
}
TOP = {
    "actions", "algorithm", "device", "environment", "errors", "files", "gymlanes", "hookspecs", "normalization",
    "masks", "notation", "options", "own", "population", "registry", "replay", "seeding", "shortforms",
    "specs", "columns",
}  # fmt: skip
"""What a plugin or a user may import, beside `qrlsuite.api`."""

ROOMS = (
    ("statistics", "compiled"),
    ("contracts",),  # the modules of TOP
    ("circuit",),
    ("diagnostics",),
    ("experiment",),
    ("results",),
    ("training",),
    ("engine",),
    ("tuning",),
    ("studies",),
    ("leaderboard", "testing", "scaffold", "installation"),
    ("api",),
    ("cli",),
)
"""A room imports from itself and from the rows above it."""
LEVELS = {room: level for level, row in enumerate(ROOMS) for room in row}
PLUGINS_MAY = ("contracts", "statistics", "compiled", "circuit", "testing")
ENGINE_CONTRACT = "qrlsuite.engine.api"
"""What an engine may import besides."""


def modules() -> dict[str, Path]:
    found = {}
    for package, folder in FOLDERS.items():
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            name = ".".join([package, *(parts[:-1] if parts[-1] == "__init__" else parts)])
            found[name] = path
    return found


def imports(path: Path, module: str) -> set[str]:
    """Every module that a file imports anywhere, functions included, as absolute names."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            found.add(node.module or "")
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def room(name: str) -> str:
    """Return the room of a module of the suite."""
    parts = [*name.split("."), "", ""]
    if parts[0] == "qrlsuite" and parts[1] in TOP | {""}:
        return "contracts"
    return {"__main__": "cli"}.get(parts[1], parts[1])


ALL = modules()


def rooms_of(used: set[str]) -> dict[str, str]:
    """Return the modules of the suite among what is imported, with their rooms."""
    return {name: room(name) for name in used if name in ALL and name != "qrlsuite"}


@pytest.mark.parametrize("module", sorted(ALL))
def test_imports_point_one_way(module: str) -> None:
    used = imports(ALL[module], module)
    if module == "qrlsuite":
        # Functions that are its attributes, imported when they are used.
        used -= {"qrlsuite.api", "qrlsuite.circuit", "qrlsuite.circuit.layer"}
    ours, own = rooms_of(used), room(module)
    foreign = {name.partition(".")[0] for name in used} - {"qrlsuite"} - set(sys.stdlib_module_names)
    if own in ("plugins", "tasks"):  # tasks come with their environments
        upward = {name for name, where in ours.items() if where not in (*PLUGINS_MAY, "plugins")}
        if module.startswith("qrlsuite.plugins.engines."):
            upward.discard(ENGINE_CONTRACT)
    elif own == "statistics" or module == "qrlsuite.circuit.description":
        upward = {name for name, where in ours.items() if where != own and name != "qrlsuite.errors"}
        assert foreign <= {"numpy", "scipy"}, f"{module} imports {foreign}"
    else:
        level = LEVELS[own]
        upward = {name for name, where in ours.items() if where != own and LEVELS.get(where, 99) >= level}
    assert not upward, f"{module} (in {own}) imports upward: {sorted(upward)}"


def test_algorithms_import_neither_each_other_nor_a_model() -> None:
    for module, path in ALL.items():
        if module.startswith("qrlsuite.plugins.algorithms."):
            assert not [name for name in imports(path, module) if name.startswith("qrlsuite.plugins")], module


@pytest.mark.parametrize("module", sorted(ALL))
def test_no_variable_has_the_name_of_a_module_that_its_file_imports(module: str) -> None:
    nodes = [*ast.walk(ast.parse(ALL[module].read_text()))]
    names = {
        alias.asname or alias.name
        for node in nodes
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
        if isinstance(node, ast.Import) or f"{node.module}.{alias.name}" in ALL
    }
    bound = [
        node.arg if isinstance(node, ast.arg) else node.id
        for function in nodes
        if isinstance(function, ast.FunctionDef | ast.Lambda)
        for node in ast.walk(function)
        if isinstance(node, ast.arg) or (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
    ]
    assert not names.intersection(bound)


def test_the_top_level_holds_what_plugins_and_users_import() -> None:
    files = {path.stem for path in FOLDERS["qrlsuite"].glob("*.py")} - {"__init__", "__main__"}
    assert files == TOP


def test_the_package_list_names_every_folder() -> None:
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    packages = {name for name, path in ALL.items() if path.name == "__init__.py"}
    assert set(setup["packages"]) == packages
    for name, folder in FOLDERS.items():
        assert setup["package-dir"][name] == str(folder.relative_to(ROOT))


def test_python_started_in_a_checkout_finds_every_folder() -> None:
    program = (
        "import importlib, sys;"
        # Where the suite was not installed from this checkout as editable, nothing leads to its folders.
        "sys.meta_path[:] = [f for f in sys.meta_path if 'editable' not in f'{f} {type(f).__module__}'];"
        "sys.path[:] = [p for p in sys.path if 'editable' not in p];"
        f"found = [importlib.import_module(name).__file__ for name in {sorted(FOLDERS)}];"
        f"expected = [f'{{folder}}/__init__.py' for folder in {[str(FOLDERS[name]) for name in sorted(FOLDERS)]}];"
        "assert found == expected, found;"
        "import qrlsuite, gymnasium;"
        "gymnasium.make('qrlsuite/BeamManagement6G-v1').reset(seed=0)"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)


def test_what_is_not_used_is_not_imported() -> None:
    """The package imports nothing; registering, a command and the functions import no library that they do not need."""
    program = """if True:
        import sys
        def imported(*names): return set(names) & set(sys.modules)
        before = set(sys.modules)
        import qrlsuite, json, argparse
        new = {name.partition(".")[0] for name in set(sys.modules) - before} - set(sys.stdlib_module_names)
        assert new <= {"qrlsuite"}, new
        assert not imported("qrlsuite.registry", "importlib.metadata")
        import qrlsuite.cli, qrlsuite.registry
        assert not qrlsuite.registry.create(strict=True).problems
        quantum = {"pennylane", "qiskit", "qiskit_aer", "qiskit_machine_learning"}
        heavy = {"torch", "numba", "scipy", "gymnasium", "matplotlib", "sklearn"} | quantum
        assert not imported(*heavy), imported(*heavy)
        sys.argv = ["qrlsuite", "--help"]
        try:
            qrlsuite.cli.main()
        except SystemExit as end:
            assert not end.code
        assert not imported(*heavy), imported(*heavy)
        import qrlsuite.cli.commands.run, qrlsuite.cli.commands.study, qrlsuite.cli.commands.tune, qrlsuite.api
        assert not imported("torch")
        from qrlsuite.circuit import ansatz, create_backend
        create_backend("native", ansatz("iqp", 2, 1))
        assert not imported(*quantum), imported(*quantum)
    """
    subprocess.run([sys.executable, "-c", program], check=True)


UNPICKLERS = {
    "pickle", "_pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve", "marshal", "jsonpickle",
}  # fmt: skip


@pytest.mark.parametrize("module", sorted(ALL))
def test_nothing_reads_a_pickle(module: str) -> None:
    """Static: no unpickler is imported, and no library is asked to unpickle."""
    for node in ast.walk(ast.parse(ALL[module].read_text())):
        names: set[str] = set()
        if isinstance(node, ast.Import):
            names = {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names = {(node.module or "").partition(".")[0]}
        elif isinstance(node, ast.keyword):
            assert node.arg != "allow_pickle" or not getattr(node.value, "value", True)
            assert node.arg != "weights_only"
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            assert (node.value.id, node.attr) != ("torch", "load")
        assert not names & UNPICKLERS
