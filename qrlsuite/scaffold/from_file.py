"""Makes a package of a plugin by path: its file or folder, with specs for its short registrations."""

from __future__ import annotations

import ast
import dataclasses
import os
import re
from collections.abc import Iterator, Sequence
from typing import Any

from qrlsuite import own, registry, shortforms, specs
from qrlsuite.scaffold import Package, ScaffoldError, commands_of, names_of, rendered

_PRIVATE = "_qrlsuite_"
"""How names begin under which short forms are in their module."""


@dataclasses.dataclass(frozen=True)
class _Short:
    """A short form: the function or class, and the nodes of its parameters that are options."""

    spec: specs.Spec
    name: str
    parameters: Sequence[tuple[ast.arg, ast.expr]]
    whole: str
    """The name of the options class, where the form has one of its own."""
    asked: Sequence[str]
    circuits: bool = False
    """Whether a model leaves its quantum parameters to be found."""

    @property
    def options(self) -> str:
        return self.whole or f"{''.join(word.title() for word in self.spec.name.split('-'))}Options"

    @property
    def made(self) -> str:
        verb = "make" if isinstance(self.spec, specs.EnvironmentSpec) else "build"
        return f"{verb}_{self.spec.name.replace('-', '_')}"


def package(path: str | os.PathLike[str], name: str | None = None) -> Package:
    """Render a package of a plugin's file or folder.

    Parameters
    ----------
    name:
        Name of the distribution; None takes the name of the file or folder.
    """
    others = [name for name in own.read(path).files if "/" not in name and name.endswith(".py")][1:]
    if others:
        raise ScaffoldError(f"{path} imports {others[0]}: make a package's folder of both")
    made = own.load(path)
    kept = made.registered
    own.unload(made)
    source = made.source
    name = source.module.strip("_").replace("_", "-") if name is None else name
    module, _ = names_of(name, [])
    if module != source.module:
        names_of(source.module.strip("_").replace("_", "-"), [])
    module = source.module
    text = source.files[f"{module}/__init__.py" if source.name == module else source.name].decode()
    tree = ast.parse(text)
    inner = "" if _hooks(tree) else ("parts" if source.name == module else module)
    if f"{module}/parts.py" in source.files and inner == "parts":
        raise ScaffoldError(
            f"{source.path} has a file parts.py, in whose place its __init__.py would be: rename it"
        )
    shorts = [short for each in kept if (short := _short(each.spec, tree, source)) is not None]
    files = {
        f"src/{file}": content.decode() for file, content in source.files.items() if source.name == module
    }
    if inner:
        files[f"src/{module}/{inner}.py"] = _with_specs(text, tree, shorts)
        files[f"src/{module}/__init__.py"] = _registration(kept, shorts, module, inner)
    else:
        files[f"src/{module}/__init__.py"] = text
    kinds = [each.spec for each in kept]
    checks = [f"qrlsuite check {spec.kind.replace('_', '-')}:{spec.name}" for spec in kinds]
    commands = ("pytest", *checks, *(line for spec in kinds for line in commands_of(spec.kind, spec.name)))
    contents = {
        f"src/{module}/__init__.py": "registers with qrlsuite",
        **({f"src/{module}/{inner}.py": f"what was {source.name}: edit this"} if inner else {}),
        f"tests/test_{module}.py": "runs qrlsuite's checks",
    }
    summary = " ".join(kinds[0].summary.rstrip(".").split()) if kinds else f"what {source.name} registers"
    values = {"name": name, "module": module, "thing": kinds[0].name if kinds else name, "kind": "plugin"}
    values |= {"things": [(spec.kind, spec.name) for spec in kinds]}
    values |= {"article": "a", "summary": re.sub(r'["\\]', "'", summary)}
    data = any(not file.endswith(".py") for file in source.files)
    common = rendered({**values, "commands": commands, "contents": list(contents.items()), "files": data})
    return Package(name, module, values["thing"], commands, {**common, **files, f"src/{module}/py.typed": ""})


def _hooks(tree: ast.Module) -> bool:
    return any(
        isinstance(node, ast.FunctionDef)
        and any("hookimpl" in ast.unparse(each) for each in node.decorator_list)
        for node in tree.body
    )


def _short(spec: specs.Spec, tree: ast.Module, source: own.Source) -> _Short | None:
    """Return the short form that a spec was made of; None where it was written as a spec."""
    references = [
        value for each in dataclasses.fields(spec) if _PRIVATE in str(value := getattr(spec, each.name))
    ]
    if not references:
        return None
    found = re.search(rf":{_PRIVATE}(.+)_(options|build|make|factory)$", str(references[0]))
    name = found[1] if found is not None else ""
    owner = node = next((n for n in tree.body if getattr(n, "name", None) == name), None)
    if isinstance(node, ast.ClassDef):
        node = next((n for n in node.body if getattr(n, "name", None) == "__init__"), None)
    if not isinstance(node, ast.FunctionDef):
        raise ScaffoldError(
            f"{source.path}: the signature of '{name}' is not in it: write its __init__ there"
        )
    arguments = node.args.args[1:] if node.name == "__init__" else node.args.args
    defaults: list[ast.expr | None] = [None] * (len(node.args.args) - len(node.args.defaults)) + [
        *node.args.defaults
    ]
    defaults = defaults[1:] if node.name == "__init__" else defaults
    pairs = [
        *zip(arguments, defaults, strict=True),
        *zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True),
    ]
    first = 2 if isinstance(spec, specs.AnsatzSpec | specs.ModelSpec) else 0
    handed = shortforms.HANDED if isinstance(spec, specs.AlgorithmSpec) else ()
    asked = (
        [a.arg for a, _ in pairs if a.arg in shortforms.ASKED] if isinstance(spec, specs.ModelSpec) else []
    )
    rest = [(a, d) for a, d in pairs[first:] if a.arg not in (*handed, *asked)]
    reference = str(getattr(spec, "options", ""))
    whole = "" if _PRIVATE in reference else reference.partition(":")[2]
    found_here = [n.name for n in getattr(owner, "body", []) if isinstance(n, ast.FunctionDef)]
    circuits = isinstance(spec, specs.ModelSpec) and "quantum_parameters" not in found_here
    return _Short(
        spec, name, [(a, d) for a, d in rest if d is not None and not whole], whole, asked, circuits
    )


def _with_specs(text: str, tree: ast.Module, shorts: Sequence[_Short]) -> str:
    """Return a file's text without calls of `register`, with options classes and functions of its short forms below."""
    lines = text.splitlines(keepends=True)
    for first, last, line in _register(tree):
        lines[first - 1 : last] = [line, *[""] * (last - first)]
    start = next((node.lineno for node in tree.body if not _before_imports(node)), len(lines) + 1)
    start = min([start, *(d.lineno for n in tree.body for d in getattr(n, "decorator_list", []))])
    imports = ["import typing\n", "\n", "import pydantic\n"] if any(not each.whole for each in shorts) else []
    body = "".join([*lines[: start - 1], *imports, *lines[start - 1 :]]).rstrip("\n") + "\n"
    return "\n\n".join([body.lstrip("\n"), *(piece for short in shorts for piece in _pieces(short))])


def _before_imports(node: ast.stmt) -> bool:
    return (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)) or (
        isinstance(node, ast.ImportFrom) and node.module == "__future__"
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


def _pieces(short: _Short) -> Iterator[str]:
    spec, name, whole = short.spec, short.name, short.whole
    if not whole:
        fields = "".join(f"    {_field(name, *pair)}\n" for pair in short.parameters)
        yield (
            '@pydantic.dataclasses.dataclass(frozen=True, config=pydantic.ConfigDict(extra="forbid"))\n'
            f"class {short.options}:\n"
            f'    """Options of `{name}`; `qrlsuite show {spec.kind} {spec.name}` lists them."""\n'
            + (f"\n{fields}" if fields else "")
        )
    given = [f"{a.arg}=options.{a.arg}" for a, _ in short.parameters] if not whole else ["options=options"]
    given += [f"{each}={each}" for each in short.asked]
    more = "".join(f", {each}: typing.Any = None" for each in short.asked if each != "generator")
    said = f'    """Build `{name}` with its options."""\n'
    if isinstance(spec, specs.AnsatzSpec):
        if whole:
            return
        head = f"def {short.made}(qubits: int, layers: int, options: {short.options}) -> typing.Any:\n"
        yield f"{head}{said}    return {name}({', '.join(['qubits', 'layers', *given])})\n"
    elif isinstance(spec, specs.ModelSpec):
        head = f"def {short.made}(\n    obs_dim: int, out_dim: int, options: {short.options}, "
        if spec.family == "quantum" and short.circuits:
            yield (
                "from qrlsuite.shortforms import circuit_parameters  # noqa: E402\n\n"
                f"{name}.quantum_parameters = circuit_parameters\n"
            )
        head += f"generator: typing.Any{more}\n) -> typing.Any:\n{said}"
        yield f"{head}    return {name}({', '.join(['obs_dim', 'out_dim', *given])})\n"
    elif isinstance(spec, specs.EnvironmentSpec):
        yield (
            f"def {short.made}(**options: typing.Any) -> typing.Any:\n"
            f'    """Make `{name}`; an episode ends after {shortforms.EPISODE_STEPS} steps."""\n'
            "    from gymnasium.wrappers import TimeLimit\n\n"
            f"    return TimeLimit({name}(**options), {shortforms.EPISODE_STEPS})\n"
        )
    elif isinstance(spec, specs.AlgorithmSpec):
        head = f"def {short.made}(envs: typing.Any, build_model: typing.Any, options: {short.options}, "
        handed = [f"{each}={each}" for each in shortforms.HANDED]
        yield (
            f"{head}streams: typing.Any,\n    device: typing.Any) -> typing.Any:\n{said}"
            f"    return {name}({', '.join([*handed, *given])})\n"
        )


def _field(owner: str, argument: ast.arg, default: ast.expr) -> str:
    value = ast.unparse(default)
    kind = (
        type(ast.literal_eval(default)).__name__
        if argument.annotation is None
        else ast.unparse(argument.annotation)
    )
    if "description=" not in kind:
        kind = f'typing.Annotated[{kind}, pydantic.Field(description="argument of {owner}")]'
    if isinstance(default, ast.List | ast.Dict | ast.Set):
        value = f"pydantic.Field(default_factory=lambda: {value})"
    return f"{argument.arg}: {kind} = {value}"


def _registration(
    kept: Sequence[registry.Registered[Any]], shorts: Sequence[_Short], module: str, inner: str
) -> str:
    """Return a module of hooks that register specs."""
    made = {(type(short.spec), short.spec.name): short for short in shorts}
    pieces = [
        '"""What qrlsuite loads at every start: register here, import nothing heavy."""\n\n'
        "from __future__ import annotations\n\nfrom collections.abc import Callable\n\n"
        "from qrlsuite import hookimpl, specs\n"
    ]
    for kind in dict.fromkeys(type(each.spec) for each in kept):
        calls = [each.spec for each in kept if type(each.spec) is kind]
        body = "".join(_call(spec, made.get((type(spec), spec.name)), module, inner) for spec in calls)
        names = ", ".join(spec.name for spec in calls)
        pieces.append(
            f"@hookimpl\ndef register_{kind.kinds}(register: Callable[[specs.{kind.__name__}], None]) -> None:\n"
            f'    """Register {names}."""\n{body}'
        )
    return "\n\n".join(pieces)


def _call(spec: specs.Spec, short: _Short | None, module: str, inner: str) -> str:
    lines = []
    for each in dataclasses.fields(spec):
        value = getattr(spec, each.name)
        if each.default is not dataclasses.MISSING and value == each.default:
            continue
        if isinstance(value, str) and value.startswith(f"{module}:"):
            word = value.partition(":")[2]
            if short is not None and word.startswith(_PRIVATE):
                whole = short.whole and isinstance(spec, specs.AnsatzSpec) and each.name == "build"
                word = short.options if each.name == "options" else short.name if whole else short.made
            value = f"{module}.{inner}:{word}"
        if not value and each.default_factory is not dataclasses.MISSING:
            continue
        written = (
            '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
            if isinstance(value, str)
            else repr(value)
        )
        lines.append(f"            {each.name}={written},\n")
    return f"    register(\n        specs.{type(spec).__name__}(\n{''.join(lines)}        )\n    )\n"
