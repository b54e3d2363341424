"""Search spaces: the varied options and their values.

A grid is a TOML file, `[search.ALGORITHM.FAMILY]` with lists of values by option, each of the two a name or
`all`:

    format_version = 1

    [search.ddqn.all]
    lr = [1e-3, 5e-4]
    gamma = { low = 0.9, high = 0.99 }

    [search.ddqn.classical]
    width = [16, 64]

A range (`low`, `high`, and `log = true` for learning rates) is for samplers that draw. Option names are written as in
`--set`, with `algorithm.` or `model.` before them if both have one; `"activation_in+activation_out"` gives both options
one value. Named grids lie in a folder `search` beside the task files of the suite and of plugins.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field, FiniteFloat, model_validator

from qrlsuite import files, options, registry, specs
from qrlsuite.errors import OptionError, UnknownNameError, nearest
from qrlsuite.experiment.entry import Entry
from qrlsuite.options import Setting, Table

FOLDER = "search"
_WORD = r"[^\s={\[]+=[^\s={\[]+"
ROW = re.compile(rf"preset=\S+(\s+{_WORD})*|{_WORD}(\s+{_WORD})+")
"""Settings given by hand."""
_ALONE = re.compile(r"[^\s={\[,]+=[^\s={\[,]+")
"""One value of one option: settings given by hand beside other such settings, else a list of one value."""
Point = dict[str, Any]
"""A value for every dimension, by its full name (`algorithm.lr`)."""


class Range(Table):
    """All numbers from `low` to `high`: integers if both are."""

    low: int | FiniteFloat
    high: int | FiniteFloat
    log: bool = False

    @model_validator(mode="after")
    def _ordered(self) -> Range:
        if not self.low < self.high or (self.log and self.low <= 0):
            raise ValueError("low < high is needed, and 0 < low with log")
        return self

    @property
    def integer(self) -> bool:
        """Whether the range is of integers."""
        return isinstance(self.low, int) and isinstance(self.high, int)


@dataclass(frozen=True)
class Dimension:
    """An option's full name, and either its values or its range."""

    name: str
    values: tuple[Any, ...] = ()
    range: Range | None = None

    def plain(self) -> Any:
        """Return the dimension as in a grid file."""
        if self.range is None:
            return list(self.values)
        log = {"log": True} if self.range.log else {}
        return {"low": self.range.low, "high": self.range.high, **log}


Space = tuple[Dimension, ...]
Tables = dict[str, dict[Literal["all", "classical", "quantum"], dict[str, list[Any] | Range]]]


class GridFile(Table):
    """A whole grid file."""

    format_version: Literal[1]
    summary: str = ""
    search: Annotated[Tables, Field(min_length=1)]


def grids() -> dict[str, Path]:
    """Return the grids beside the registered tasks by name; the suite's own come first where two share one."""
    folders = dict.fromkeys(
        Path(item.spec.path).parent / FOLDER for _, item in sorted(registry.load().of(specs.TaskSpec).items())
    )
    paths: dict[str, Path] = {}
    for folder in folders:
        for path in sorted(folder.glob("*.toml")):
            paths.setdefault(path.stem, path)
    return paths


def load(name: str) -> GridFile:
    """Read a grid by name, or by path (anything that ends in `.toml`)."""
    known = grids()
    if not name.endswith(".toml") and name not in known:
        raise UnknownNameError(
            f"unknown grid '{name}'{nearest(name, known)}; or give a file, my-grid.toml, or 'lr=[1e-3, 5e-4]'"
        )
    path = Path(name) if name.endswith(".toml") else known[name]
    return files.load(path, GridFile, "grid file")


def declared(entry: Entry) -> dict[str, Range]:
    """Return the ranges of the options that an entry's algorithm and model mark as tuned, by full name.

    Options without effect beside the entry's other options are left out: refused options, and options of quantum
    parameters if the circuit stays as drawn.
    """
    from qrlsuite.training.trainer import count_parameters  # torch is slow to import

    families = {None, entry.model.family}
    if entry.model.family == "quantum" and not count_parameters(entry)[1]:
        families.remove("quantum")
    sides = {
        "algorithm": (specs.resolve(entry.algorithm.options), entry.algorithm_options),
        "model": (specs.resolve(entry.model.options), entry.model_options),
    }
    return {
        f"{side}.{name}": Range(low=mark.low, high=mark.high, log=True)
        for side, (cls, own) in sides.items()
        for name, mark in options.tuned(cls).items()
        if mark.family in families and _accepted(cls, {**options.plain(own), name: mark.low})
    }


def _accepted(cls: type[Any], values: Mapping[str, Any]) -> bool:
    try:
        built = options.build(cls, values, "tuned options")
        if hasattr(built, "check"):
            built.check()
    except OptionError:
        return False
    return True


def space(
    entry: Entry,
    grid: GridFile | None,
    varied: Sequence[Setting] = (),
    fixed: Sequence[Setting] = (),
    ranges: Mapping[str, Range] | None = None,
) -> Space:
    """Return the search space of an entry.

    Parameters
    ----------
    entry:
        Algorithm, model and the values of all options that are not varied.
    grid:
        A grid file; its tables for the entry's algorithm and family are taken, `all` first.
    varied:
        Further options with lists of values (or ranges) of their own; they replace the grid's.
    fixed:
        Options that shall not be varied.
    ranges:
        Varied ranges without a grid file, by full name.
    """
    sides = {"model": specs.resolve(entry.model.options), "algorithm": specs.resolve(entry.algorithm.options)}
    axes: dict[str, list[Any] | Range] = dict(ranges or {})
    tables = grid.search if grid is not None else {}
    for algorithm in ("all", entry.algorithm.name):
        for family in ("all", entry.model.family):
            for word, values in tables.get(algorithm, {}).get(family, {}).items():
                axes[_full_name(word, sides, "search: ")] = values
    for setting in varied:
        name = _full_name(_word(setting), sides, "--vary ")
        _forget(axes, name)
        axes[name] = _values(name, setting.value)
    for setting in fixed:
        if setting.side == "ansatz" and setting.name in getattr(sides["model"], "passes_on", ()):
            _forget(axes, f"model.{setting.name}")
        elif setting.side not in ("environment", "ansatz") and (setting.side or _owned(setting.name, sides)):
            _forget(axes, _full_name(_word(setting), sides, setting.prefix))
    if not axes:
        if varied:
            words = ", ".join(_word(setting) for setting in varied)
            raise OptionError(
                f"nothing is varied: the entry fixes what --vary names ({words}); leave it out there"
            )
        raise OptionError(
            f"nothing is varied for {entry.algorithm.name} with {entry.model.name}: --vary takes a grid's name, a grid "
            "file or 'lr=[1e-3, 5e-4]'"
        )
    result = tuple(_dimension(name, values) for name, values in axes.items())
    for dimension in result:
        _check(dimension, sides, entry)
    return result


def _word(setting: Setting) -> str:
    return setting.name if setting.side is None else f"{setting.side}.{setting.name}"


def _owned(name: str, sides: Mapping[str, type[Any]]) -> bool:
    """Tell whether an option belongs to the model or the algorithm, and not to the environment."""
    return any(name in options.field_names(cls) for cls in sides.values())


def _full_name(word: str, sides: Mapping[str, type[Any]], prefix: str) -> str:
    """Return option names with their sides: `lr` as `algorithm.lr`, `a+b` as `model.a+model.b`.

    Parameters
    ----------
    prefix:
        Text before the name in the user's words, for messages.
    """
    parts = []
    for part in word.split("+"):
        side, dot, name = part.strip().partition(".")
        setting = Setting(side, name, None, prefix) if dot else Setting(None, side, None, prefix)
        for owner, values in options.assign([setting], sides).items():
            parts += [f"{owner}.{option}" for option in values]
    return "+".join(parts)


def _forget(space: dict[str, Any], name: str) -> None:
    """Drop every dimension that shares an option with a name."""
    for known in list(space):
        if set(known.split("+")) & set(name.split("+")):
            del space[known]


def parse_varied(word: str) -> Setting:
    """Parse a word of `--vary`: `lr=[1e-3, 5e-4]`, `lr=1e-3,5e-4`, `activation=relu,tanh`, `lr={low=.1, high=1}`."""
    key, equals, values_text = word.partition("=")
    if not equals or not key.strip():
        raise OptionError(f"--vary {word}: write a name and its values, --vary 'lr=[1e-3, 5e-4]'")
    text = re.sub(r"(?<![\w.])\.(?=\d)", "0.", values_text.strip())
    value = options.parse_value(text)
    if not isinstance(value, list | dict) and not text.startswith(("[", "{")):
        value = [options.parse_value(part.strip()) for part in text.split(",") if part.strip()]
    side, dot, name = key.strip().partition(".")
    return Setting(side, name, value) if dot else Setting(None, side, value)


def read_varied(
    vary: str | Sequence[str] | Mapping[str, Any],
) -> tuple[GridFile | None, tuple[Setting, ...], tuple[str, ...]]:
    """Return a grid, the options with values of their own, and settings given by hand.

    Parameters
    ----------
    vary:
        Words, each a grid's name, a grid file's path, `NAME=VALUES`, or settings: `NAME=VALUE NAME=VALUE` or
        `preset=NAME`; or a mapping of option names to values.
    """
    if isinstance(vary, Mapping):
        varied = {name: list(v) if isinstance(v, tuple) else v for name, v in vary.items()}
        return None, tuple(options.from_mapping(varied)), ()
    words = [vary] if isinstance(vary, str) else list(vary)
    words = [word.strip() for word in words]
    rows = tuple(word for word in words if ROW.fullmatch(word))
    if rows:
        rows = tuple(word for word in words if word in rows or _ALONE.fullmatch(word))
    words = [word for word in words if word not in rows]
    grids = [word for word in words if "=" not in word]
    if len(grids) > 1:
        raise OptionError(f"--vary {grids[0]} --vary {grids[1]}: give one grid")
    given = tuple(parse_varied(word) for word in words if "=" in word)
    return load(grids[0]) if grids else None, given, rows


def only_lists(grid: GridFile | None, varied: Sequence[Setting]) -> bool:
    """Whether options are varied, and each by a list of values."""
    in_file = [
        values
        for families in (grid.search if grid else {}).values()
        for names in families.values()
        for values in names.values()
    ]
    values = [*in_file, *(setting.value for setting in varied)]
    return bool(values) and all(isinstance(each, list) for each in values)


def _values(name: str, value: Any) -> list[Any] | Range:
    """Read the value of `--vary`: a list, or a range as an inline table."""
    if isinstance(value, list):
        return value
    if isinstance(value, dict):
        try:
            return Range.model_validate(value)
        except pydantic.ValidationError as error:
            raise OptionError(f"--vary {name}: {'; '.join(files.validation_lines(error))}") from None
    raise OptionError(
        f"--vary {name}: write a list of values, --vary '{name}=[1, 2]', or {{low = 1, high = 2}}"
    )


def _dimension(name: str, values: list[Any] | Range) -> Dimension:
    if isinstance(values, Range):
        return Dimension(name, range=values)
    distinct = [value for i, value in enumerate(values) if value not in values[:i]]
    if not distinct:
        raise OptionError(f"{name}: the list of values to try is empty")
    return Dimension(name, tuple(distinct))


def admits(entry: Entry, dimension: Dimension) -> bool:
    """Return whether an entry's option can have every value of a dimension, or both ends of its range."""
    sides = {"model": specs.resolve(entry.model.options), "algorithm": specs.resolve(entry.algorithm.options)}
    try:
        _check(dimension, sides, entry)
    except OptionError:
        return False
    return True


def _check(dimension: Dimension, sides: Mapping[str, type[Any]], entry: Entry) -> None:
    """Raise OptionError unless the option can have every value (or both ends of its range)."""
    ends = dimension.range
    for part in dimension.name.split("+"):
        side, _, name = part.partition(".")
        if side not in sides or name not in options.field_names(sides[side]):
            known = sides if side not in sides else options.field_names(sides[side])
            raise OptionError(
                f"{part}: no option of that name{nearest(name if side in sides else side, known)}"
            )
        current = options.plain(entry.model_options if side == "model" else entry.algorithm_options)
        for value in dimension.values if ends is None else (ends.low, ends.high):
            options.build(sides[side], {**current, name: value}, f"a trial with {part} = {value!r}")


def base(space: Space, entry: Entry) -> Point:
    """Return the point of an entry's own values; of several options that vary as one, the first's."""
    values = {
        "algorithm": options.plain(entry.algorithm_options),
        "model": options.plain(entry.model_options),
    }
    point = {}
    for dimension in space:
        side, _, name = dimension.name.partition("+")[0].partition(".")
        point[dimension.name] = values[side][name]
    return point


def settings(point: Mapping[str, Any]) -> list[Setting]:
    """Return a point as settings, as `--set` would give them."""
    chosen = []
    for full, value in point.items():
        for part in full.split("+"):
            side, _, name = part.partition(".")
            chosen.append(Setting(side, name, value))
    return chosen


def text(point: Mapping[str, Any]) -> str:
    """Write a point in a line: `lr=0.001 gamma=0.9`."""
    short = ["+".join(part.partition(".")[2] for part in full.split("+")) for full in point]
    names = [s if short.count(s) == 1 else full for full, s in zip(point, short)]
    return " ".join(
        f"{name}={value:.4g}" if isinstance(value, float) else f"{name}={value}"
        for name, value in zip(names, point.values())
    )
