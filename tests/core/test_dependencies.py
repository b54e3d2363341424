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
CORE_MAY_NOT = ("qrlsuite.plugins", "qrlsuite.cli", "qrlsuite.leaderboard", "qrlsuite.tasks")


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


def inside(name: str, packages: tuple[str, ...]) -> bool:
    return any(name == package or name.startswith(package + ".") for package in packages)


ALL = modules()


@pytest.mark.parametrize("module", sorted(ALL))
def test_imports_point_one_way(module: str) -> None:
    used = imports(ALL[module], module)
    ours = {name for name in used if inside(name, ("qrlsuite",))}
    if inside(module, ("qrlsuite.statistics",)):
        allowed = ("qrlsuite.errors", "qrlsuite.statistics")
        assert all(name == "qrlsuite" or inside(name, allowed) for name in ours), ours
        foreign = {name.partition(".")[0] for name in used - ours} - set(sys.stdlib_module_names)
        assert foreign <= {"numpy", "scipy"}, foreign
    elif module == "qrlsuite.circuit.description":
        assert all(inside(name, ("qrlsuite.errors",)) or name == "qrlsuite" for name in ours), ours
        assert {name.partition(".")[0] for name in used - ours} - set(sys.stdlib_module_names) <= {"numpy"}
    elif inside(module, ("qrlsuite.plugins.algorithms",)) and module != "qrlsuite.plugins.algorithms":
        others = ("qrlsuite.plugins", "qrlsuite.training.group", "qrlsuite.cli", "qrlsuite.leaderboard")
        assert not any(inside(name, others) for name in ours), (
            "algorithms import neither each other nor a model"
        )
    elif inside(module, ("qrlsuite.plugins", "qrlsuite.tasks")):
        others = ("qrlsuite.training.group", "qrlsuite.cli", "qrlsuite.leaderboard", "qrlsuite.engine")
        assert not any(inside(name, others) for name in ours), ours
    elif inside(module, ("qrlsuite.leaderboard",)):
        assert not any(inside(name, ("qrlsuite.cli", "qrlsuite.plugins")) for name in ours), ours
    elif inside(module, ("qrlsuite.cli", "qrlsuite.__main__")):
        assert not any(inside(name, ("qrlsuite.plugins",)) for name in ours), ours
    else:
        assert not any(inside(name, CORE_MAY_NOT) for name in ours), ours


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
        "import gymnasium, qrlsuite;"
        "qrlsuite.register_environments();"
        "gymnasium.make('qrlsuite/BeamManagement6G-v1').reset(seed=0)"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)


def test_registering_imports_nothing_heavy() -> None:
    program = (
        "import sys, qrlsuite.registry as r; assert not r.create(strict=True).problems; "
        "heavy = {'torch', 'pennylane', 'qiskit', 'numba', 'scipy', 'gymnasium', 'matplotlib'} & set(sys.modules); "
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
