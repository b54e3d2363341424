"""Options of models, algorithms and environments: pydantic dataclasses, set by defaults, presets and `--set`.

Every error names the value's source, its fault, and a valid value.
"""

from __future__ import annotations

import ast
import contextlib
import datetime
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Literal

import pydantic
import pydantic_core
from packaging.version import Version

from qrlsuite.errors import OptionError, PluginError, nearest
from qrlsuite.files import read_toml, validation_lines

Values = dict[str, Any]


class Table(pydantic.BaseModel):
    """A table of a TOML file: unknown keys are refused, and nothing changes after reading."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


@dataclass(frozen=True)
class Since:
    """Marks an option that was added to a released options class, with the version that brought it.

    ::

        momentum: Annotated[float, Field(ge=0, description="..."), Since("0.2.0")] = 0.0

    The default does the same as before the option existed, and never changes: an option at its default is left out of
    the entry's identity, hash and label (an environment's option, out of the task's hash), so that earlier
    results keep their names and random streams, and are resumed.

    Attributes
    ----------
    version:
        Version of the package that has the options class.
    """

    version: str

    def __post_init__(self) -> None:
        if not isinstance(self.version, str) or re.fullmatch(r"\d+(\.\d+)+", self.version) is None:
            raise PluginError(
                f"Since({self.version!r}): write the version that brought the option, such as 0.2.0"
            )


@dataclass(frozen=True)
class Tuned:
    """Marks an option that `qrlsuite tune` searches, with the range in which the search begins.

    ::

        lr: Annotated[float, Field(gt=0, description="..."), Tuned(2e-4, 1e-2)] = 5e-4

    Values are drawn log-uniformly, in steps of a factor of two where agents of one population cannot differ in them.
    Where the best one lies at an end of the range, the search goes on beyond it, as far as the option admits.

    With `per_agent=True`, agents of one population may have different values of the option, and a search trains many
    of its settings side by side in one population. `build` of a model gets each agent's own options. An algorithm's
    factory, and `population` of a model, get a float64 tensor (S,) of the agents' values where these differ, and the
    number where they do not: each agent must end, bit for bit, as if trained alone. `qrlsuite check` verifies it.

    Attributes
    ----------
    low, high:
        0 < low < high.
    family:
        Tuned only for models of this family; None for all.
    per_agent:
        Whether agents of one population may have different values.
    """

    low: float
    high: float
    family: Literal["classical", "quantum"] | None = None
    per_agent: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.low < self.high < math.inf:
            raise PluginError(f"Tuned({self.low!r}, {self.high!r}): give a range with 0 < low < high")


def field_names(cls: type[Any]) -> list[str]:
    """Return the option names of an options dataclass."""
    return [f.name for f in fields(cls)]


def describe(cls: type[Any]) -> list[dict[str, Any]]:
    """Return name, type, default and description of every option, and where it was added later the version."""
    from qrlsuite import __version__

    properties = pydantic.TypeAdapter(cls).json_schema().get("properties", {})
    added = later(cls)
    rows = []
    for name in field_names(cls):
        schema = properties.get(name, {})
        row = {
            "name": name,
            "values": _values(schema),
            "default": schema.get("default"),
            "description": schema.get("description", ""),
        }
        if name in added:
            row["since"], _ = added[name]
            if Version(row["since"]) <= Version(__version__):  # others are new in what is not yet released
                row["description"] += f" (since {row['since']})"
        rows.append(row)
    return rows


def _values(schema: Mapping[str, Any]) -> str:
    """Say in a few words which values a JSON schema admits."""
    if "enum" in schema:
        return " | ".join(map(typed, schema["enum"]))
    if "const" in schema:
        return typed(schema["const"])
    if "anyOf" in schema:
        return " or ".join(_values(s) for s in schema["anyOf"])
    kind = str(schema.get("type", "value"))
    bounds = [
        f"{sign} {schema[key]:g}"
        for key, sign in (
            ("minimum", ">="),
            ("exclusiveMinimum", ">"),
            ("maximum", "<="),
            ("exclusiveMaximum", "<"),
        )
        if key in schema
    ]
    return " ".join([kind, *bounds])


def typed(value: Any) -> str:
    """Write a value in the form that `--set NAME=` reads."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def build(cls: type[Any], values: Mapping[str, Any], where: str) -> Any:
    """Validate values into an options object.

    Parameters
    ----------
    values:
        Given values by name; absent ones take their defaults.
    where:
        Owner of the values, for messages: `"model 'mlp'"`.

    Raises
    ------
    OptionError
        Listing every unknown name (with its nearest match) and every bad value at once.
    """
    known = field_names(cls)
    problems = [
        f"{where} has no option '{name}'{nearest(name, known) if known else ': it has none'}"
        for name in values
        if name not in known
    ]
    try:
        result = pydantic.TypeAdapter(cls).validate_python({k: v for k, v in values.items() if k in known})
    except pydantic.ValidationError as error:
        problems += [f"{where}: {line}" for line in validation_lines(error)]
    problems += [
        f"{where}: {name} = {value}: infinite numbers cannot be written to JSON, and so not be part of an identity"
        for name, value in values.items()
        if _infinite(value)
    ]
    if problems:
        raise OptionError("; ".join(problems))
    return result


def _infinite(value: Any) -> bool:
    """Return whether a value is an infinite number, or holds one."""
    if isinstance(value, list | tuple):
        return any(map(_infinite, value))
    if isinstance(value, Mapping):
        return any(map(_infinite, value.values()))
    return isinstance(value, float) and math.isinf(value)


def plain(options: Any) -> Values:
    """Return an options object as JSON-compatible values, every default written out."""
    result: Values = pydantic.TypeAdapter(type(options)).dump_python(options, mode="json")
    return result


def identity(options: Any) -> Values:
    """Return the content of an entry's hash: `plain` without the options marked `Since` that have their default."""
    result: Values = _without_later(options, plain(options))
    return result


def _without_later(value: Any, written: Any) -> Any:
    """Leave out options marked `Since` that have their default, at any depth.

    Parameters
    ----------
    written:
        The value as `plain` writes it.
    """
    if isinstance(written, dict) and (is_dataclass(value) or isinstance(value, pydantic.BaseModel)):
        kept = without_later(type(value), written)
        return {name: _without_later(getattr(value, name, None), item) for name, item in kept.items()}
    if isinstance(written, dict) and isinstance(value, Mapping) and len(value) == len(written):
        return {
            name: _without_later(inner, item) for inner, (name, item) in zip(value.values(), written.items())
        }
    if isinstance(written, list) and isinstance(value, list | tuple) and len(value) == len(written):
        return [_without_later(inner, item) for inner, item in zip(value, written)]
    return written


def without_later(cls: type[Any], values: Mapping[str, Any]) -> Values:
    """Return values of an options class without the options marked `Since` that have their default.

    Parameters
    ----------
    values:
        Plain values by name, any number of them.
    """
    added = later(cls)
    return {name: value for name, value in values.items() if name not in added or value != added[name][1]}


def later(cls: type[Any]) -> dict[str, tuple[str, Any]]:
    """Return version and plain default of every option marked `Since`, by name."""
    added = {}
    for name, info in _pydantic_fields(cls).items():
        for mark in info.metadata:
            if isinstance(mark, Since):
                if info.is_required():
                    raise PluginError(
                        f"{cls.__name__}.{name} was added in {mark.version} and needs a default"
                    )
                default = info.get_default(call_default_factory=True)
                added[name] = mark.version, pydantic_core.to_jsonable_python(default)
    return added


def tuned(cls: type[Any]) -> dict[str, Tuned]:
    """Return the marks of every option marked `Tuned`, by name."""
    fields_of = _pydantic_fields(cls)
    return {n: mark for n, info in fields_of.items() for mark in info.metadata if isinstance(mark, Tuned)}


def listed_values(cls: type[Any]) -> dict[str, list[Any]]:
    """Return, by name, the values of every option that lists them: of a `Literal`, or true and false."""
    properties = pydantic.TypeAdapter(cls).json_schema().get("properties", {})
    return {name: values for name, schema in properties.items() if (values := _listed(schema))}


def _listed(schema: Mapping[str, Any]) -> list[Any]:
    if schema.get("type") == "boolean":
        return [True, False]
    own = [schema["const"]] if "const" in schema else schema.get("enum", [])
    return [*own, *(value for each in schema.get("anyOf", ()) for value in _listed(each))]


def per_agent(cls: type[Any]) -> set[str]:
    """Return the names of the options in which agents of one population may differ."""
    return {name for name, mark in tuned(cls).items() if mark.per_agent}


def _pydantic_fields(cls: type[Any]) -> Mapping[str, pydantic.fields.FieldInfo]:
    """Return pydantic's field of every option, for a plain dataclass too."""
    if is_dataclass(cls) and not hasattr(cls, "__pydantic_fields__"):
        cls = pydantic.dataclasses.dataclass(cls, frozen=vars(cls)["__dataclass_params__"].frozen)
    return getattr(cls, "model_fields", None) or getattr(cls, "__pydantic_fields__", {})


@dataclass(frozen=True)
class Setting:
    """One `--set side.name=value`; without a side, the one that has such an option is found.

    Attributes
    ----------
    prefix:
        What stands before it where it was written, for messages.
    """

    side: str | None
    name: str
    value: Any
    prefix: str = field(default="--set ", compare=False)

    @property
    def full_name(self) -> str:
        """The name with its side, where it has one: `model.width`."""
        return f"{self.side}.{self.name}" if self.side else self.name

    @property
    def written(self) -> str:
        """The name with its prefix: `--set model.width`."""
        return f"{self.prefix}{self.full_name}"


def parse_setting(word: str, prefix: str = "--set ") -> Setting:
    """Parse `[environment.|model.|ansatz.|algorithm.]name=value`; the value is read as TOML, else as text.

    `prefix` is the text before it in the user's words, for messages.
    """
    key, equals, text = word.partition("=")
    if not equals or not key.strip():
        raise OptionError(f"{prefix}{word}: write name=value, for example qubits=6")
    side, dot, name = key.strip().partition(".")
    value = parse_value(text.strip())
    return Setting(side, name, value, prefix) if dot else Setting(None, side, value, prefix)


def from_mapping(values: Mapping[str, Any] | None) -> list[Setting]:
    """Return settings from a mapping: `{"qubits": 6, "algorithm.gamma": 0.9}`."""
    settings = []
    for key, value in (values or {}).items():
        if not isinstance(key, str) or not key.strip():
            raise OptionError(
                f"options {key!r}: write names, for example {{'qubits': 6, 'algorithm.gamma': 0.9}}"
            )
        side, dot, name = key.strip().partition(".")
        settings.append(Setting(side if dot else None, name if dot else side, value, "option "))
    return settings


def parse_value(text: str) -> Any:
    """Read a value as TOML would (`6`, `0.5`, `.5`, `true`, `[1, 2]`, `"text"`), else as Python, else as bare text."""
    for candidate in (text, f"0{text}" if text.startswith(".") else text):
        try:
            value = read_toml(f"value = {candidate}")["value"]
        except tomllib.TOMLDecodeError:
            continue
        return text if isinstance(value, datetime.date | datetime.time) else value
    if text in ("True", "False", "None") or text.startswith(("{", "[", "'", '"')):  # as labels have them
        with contextlib.suppress(ValueError, SyntaxError, RecursionError, MemoryError):
            return ast.literal_eval(text)
    return text


def assign(settings: Sequence[Setting], sides: Mapping[str, type[Any]]) -> dict[str, Values]:
    """Distribute settings over the sides (`model`, `ansatz`, ...) that have options of that name."""
    result: dict[str, Values] = {side: {} for side in sides}
    every = {f"{side}.{name}" for side, cls in sides.items() for name in field_names(cls)}
    for setting in settings:
        owners = [side for side, cls in sides.items() if setting.name in field_names(cls)]
        if setting.side is not None:
            if setting.side not in sides:
                close = nearest(setting.side, sides)
                meant = close if "did you mean" in close else ""
                raise OptionError(f"{setting.written}: sides are {', '.join(sides)}{meant}")
            owners = [setting.side]
        if not owners:
            bare = {name.partition(".")[2] for name in every}
            raise OptionError(f"{setting.written}: no option of that name{nearest(setting.name, bare)}")
        if len(owners) > 1:
            choices = " or ".join(f"{side}.{setting.name}=..." for side in owners)
            raise OptionError(
                f"{setting.written} is an option of {' and '.join(owners)}: write {choices} in its place"
            )
        result[owners[0]][setting.name] = setting.value
    return result
