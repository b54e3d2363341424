"""Makes a package of a plugin by path: its file or folder, hooks that register what it registered, a test, a README.

A function or class that is registered by its signature stays as it is: at the end of its file, `shortforms.put_targets`
makes the options and the builder that the hooks name.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import keyword
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from qrlsuite import own, specs
from qrlsuite.errors import QrlSuiteError
from qrlsuite.shortforms import PRIVATE

TEMPLATES = Path(__file__).parent / "templates"
NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
LONGEST = 40
TRIED = {
    "ansatz": "--task beam6g --model vqc-native --set ansatz={} --quick",
    "model": "{} --task beam6g --quick",
    "environment": "mlp --task {} --quick",
    "task": "mlp --task {} --quick",
    "algorithm": "'{} mlp' --task cartpole --quick",
    "tracker": "mlp --task beam6g --quick --track {}",
}
"""The words after `qrlsuite run` to try a thing, by its kind."""


class ScaffoldError(QrlSuiteError):
    """A plugin package cannot be written under that name or at that place."""


@dataclass(frozen=True)
class Package:
    """A plugin package that can be written.

    Attributes
    ----------
    name:
        Name of the distribution: `acme-ring`.
    commands:
        Commands to type once it is installed.
    files:
        Content by path within the package.
    """

    name: str
    commands: Sequence[str]
    files: Mapping[str, bytes]


def package(path: str | os.PathLike[str], name: str | None = None) -> Package:
    """Make a package of a plugin's file or folder.

    Parameters
    ----------
    name:
        Name of the distribution; None takes the name of the file or folder.
    """
    source = own.read(path)
    module = source.module
    if others := sorted(source.modules - {module}):
        raise ScaffoldError(f"{path} imports {others[0]}.py: make a package's folder of both")
    usual = module.strip("_").replace("_", "-")
    for each in {usual, name or usual}:
        _require_usable(each)
    loaded = own.load_source(source)
    own.unload(loaded)
    registered = [each.spec for each in loaded.registered]
    top = f"{module}/__init__.py" if source.name == module else source.name
    text = source.files[top].decode()
    tree = ast.parse(text)
    files = {
        f"src/{file if source.name == module else f'{module}/{file}'}": content
        for file, content in source.files.items()
        if file != top
    }
    first = f"src/{module}/__init__.py"
    contents = {first: "registers with qrlsuite"}
    if _has_hooks(tree):
        files[first] = text.encode()
    else:
        inner = "parts" if source.name == module else module
        if f"src/{module}/{inner}.py" in files:
            raise ScaffoldError(
                f"{source.path} has a file parts.py, but that name is needed for its __init__.py: rename it"
            )
        files[first] = _registration(registered, module, inner).encode()
        files[f"src/{module}/{inner}.py"] = _with_targets(text, tree, registered).encode()
        contents[f"src/{module}/{inner}.py"] = f"what was {source.name}: edit this"
    contents[f"tests/test_{module}.py"] = "runs qrlsuite's checks"
    commands = ["pytest"]
    for spec in registered:
        commands.append(f"qrlsuite check {spec.kind.replace('_', '-')}:{spec.name}")
        if spec.kind in TRIED:
            commands.append(f"qrlsuite run {TRIED[spec.kind].format(spec.name)}")
    summary = " ".join(registered[0].summary.rstrip(".").split()) if registered else f"commands of {module}"
    values = {
        "name": name or usual,
        "module": module,
        "thing": registered[0].name if registered else usual,
        "things": [(spec.kind, spec.name) for spec in registered],
        "summary": re.sub(r'["\\]', "'", summary),
        "commands": commands,
        "contents": list(contents.items()),
        "suffixes": sorted({f"*{Path(file).suffix}" for file in files if not file.endswith(".py")}),
        "versions": compatible_versions(),
    }
    common = _rendered(values)
    return Package(name or usual, commands, {**common, **files, f"src/{module}/py.typed": b""})


def _rendered(values: Mapping[str, object]) -> dict[str, bytes]:
    """Return the files of every package, with values in the places that their templates have for them."""
    import jinja2

    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
        autoescape=False,  # Python and TOML, of names that are checked
    )
    names = {"pyproject.toml": "pyproject.toml", "README.md": "README.md"}
    names[f"tests/test_{values['module']}.py"] = "test.py"
    return {
        path: templates.get_template(f"{name}.jinja").render(values).encode() for path, name in names.items()
    }


def _require_usable(name: str) -> None:
    """Refuse a name that a distribution cannot have, or whose module Python has already."""
    if not NAME.fullmatch(name) or len(name) > LONGEST:
        usable = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-0123456789")[:LONGEST].rstrip("-")
        raise ScaffoldError(
            f"'{name}' cannot be the name of a package: lower-case letters, digits and single hyphens, beginning with "
            f"a letter, {LONGEST} characters at most" + (f"; for example {usable}" if usable else "")
        )
    module = name.replace("-", "_")
    if keyword.iskeyword(module) or module in sys.stdlib_module_names:
        raise ScaffoldError(f"'{module}' is a word of Python; for example acme-{name}")
    if importlib.util.find_spec(module) is not None:
        raise ScaffoldError(
            f"a module '{module}' is installed already: choose another name, for example acme-{name}"
        )


def _has_hooks(tree: ast.Module) -> bool:
    return any(
        isinstance(node, ast.FunctionDef)
        and any("hookimpl" in ast.unparse(each) for each in node.decorator_list)
        for node in tree.body
    )


def _with_targets(text: str, tree: ast.Module, registered: Sequence[specs.Spec]) -> str:
    """Return a file's text without calls of `register`; at its end, the targets of its short forms are made."""
    lines = text.splitlines(keepends=True)
    for first, last, line in _register(tree):
        lines[first - 1 : last] = [line, *[""] * (last - first)]
    references = [str(getattr(spec, each.name)) for spec in registered for each in dataclasses.fields(spec)]
    targets = [match[1] for each in references if (match := re.search(rf":{PRIVATE}(.+)_[a-z]+$", each))]
    body = "".join(lines).strip("\n") + "\n"
    if not targets:
        return body
    return (
        f"{body}\n\nfrom qrlsuite.shortforms import put_targets  # noqa: E402\n\n"
        f"# the options and builders that __init__.py refers to\n"
        f"put_targets(__name__, {', '.join(dict.fromkeys(targets))})\n"
    )


def _register(tree: ast.Module) -> Iterator[tuple[int, int, str]]:
    """Yield the lines of code that calls or imports `register`, and their replacement."""

    def named(node: ast.expr) -> bool:
        return (node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")) == "register"

    for node in tree.body:
        last = node.end_lineno or node.lineno
        for each in getattr(node, "decorator_list", []):
            if named(each):
                yield each.lineno, each.end_lineno, ""
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call) and named(node.value.func):
            yield node.lineno, last, ""
        if isinstance(node, ast.ImportFrom) and node.module in ("qrlsuite", "qrlsuite.api"):
            left = [alias for alias in node.names if alias.name != "register"]
            if len(left) < len(node.names):
                kept = f"{ast.unparse(ast.ImportFrom(node.module, left, 0))}\n" if left else ""
                yield node.lineno, last, kept


def _registration(registered: Sequence[specs.Spec], module: str, inner: str) -> str:
    pieces = [
        '"""What qrlsuite loads at every start: register here, import nothing heavy."""\n\n'
        "from __future__ import annotations\n\nfrom collections.abc import Callable\n\n"
        "from qrlsuite import hookimpl, specs\n"
    ]
    for kind in dict.fromkeys(type(spec) for spec in registered):
        calls = [spec for spec in registered if type(spec) is kind]
        pieces.append(
            f"@hookimpl\ndef register_{kind.kinds}(register: Callable[[specs.{kind.__name__}], None]) -> None:\n"
            f'    """Register {", ".join(spec.name for spec in calls)}."""\n'
            + "".join(_call(spec, module, inner) for spec in calls)
        )
    return "\n\n".join(pieces)


def _call(spec: specs.Spec, module: str, inner: str) -> str:
    lines = []
    for each in dataclasses.fields(spec):
        value = getattr(spec, each.name)
        if each.default is not dataclasses.MISSING and value == each.default:
            continue
        if not value and each.default_factory is not dataclasses.MISSING:
            continue
        if isinstance(value, str):
            value = re.sub(rf"^{module}:", f"{module}.{inner}:", value)
            written = '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
        else:
            written = repr(value)
        lines.append(f"            {each.name}={written},\n")
    return f"    register(\n        specs.{type(spec).__name__}(\n{''.join(lines)}        )\n    )\n"


def compatible_versions() -> str:
    """Return the version range that a plugin written for this version asks for: `>=0.1,<0.2`, or `>=1.2,<2`."""
    from qrlsuite import __version__

    major, minor = (int(number) for number in __version__.split(".")[:2])
    return f">={major}.{minor},<{major + 1}" if major else f">=0.{minor},<0.{minor + 1}"


def write(package: Package, out: Path) -> Path:
    """Write a package below a folder; returns the package's folder."""
    folder = out / package.name
    if folder.exists() or folder.is_symlink():
        raise ScaffoldError(f"{folder} exists already and is left unchanged: choose another name or --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{package.name}-", dir=out) as temporary:
            draft = Path(temporary) / package.name
            for path, content in package.files.items():
                file = draft / path
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(content)
            shutil.move(draft, folder)
    except OSError as error:
        raise ScaffoldError(f"{folder} cannot be written: {error.strerror or error}") from None
    return folder
