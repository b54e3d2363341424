"""Preset files: settings in TOML that an entry names (`mlp preset=FILE.toml`), and how they were found.

A preset's values decide an entry's identity, its name does not. If tuning found the preset, the entry carries the
record of it, so that a reader of a leaderboard knows the cost of the settings.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from qrlsuite import files, options
from qrlsuite.errors import OptionError

TUNING_SEEDS = 1_000_000
"""Seeds from here on are for tuning; protocol seeds lie below."""


class RegretRecord(options.Table):
    """How much longer than at the best settings learning takes at the settings found, as shares: 0.05 for 5 percent.

    As the search estimated it, by a surrogate (`qrlsuite.tuning.surrogate`).
    """

    goal: Annotated[float, Field(gt=0, description="the expected regret at which the search was to end")]
    expected: Annotated[float, Field(ge=0)]
    low: Annotated[float, Field(ge=0, description="5th percentile")]
    high: Annotated[float, Field(ge=0, description="95th percentile")]
    near: Annotated[float, Field(ge=0, le=1, description="probability of a regret of at most 0.03")]


class LastRoundRecord(options.Table):
    """The last round of a search: its best settings on seeds that no other trial had, and the best there taken."""

    seeds: Annotated[str, Field(max_length=10_000, description="as --seeds reads them")]
    values: Annotated[
        tuple[Annotated[float, Field(ge=0)], ...],
        Field(min_length=1, max_length=100, description="objective in steps, from best to worst"),
    ]
    expected: Annotated[float, Field(ge=0, description="regret of the settings found among these, a share")]
    low: Annotated[float, Field(ge=0, description="5th percentile")]
    high: Annotated[float, Field(ge=0, description="95th percentile")]


_LATER = ("regret", "last")


class TuningRecord(options.Table):
    """How settings were found, and at which cost; None is unknown."""

    task: Annotated[str | None, Field(max_length=80)] = None
    objective: Literal["time", "cell", "area"] | None = None
    value: Annotated[
        float | None,
        Field(ge=0, description="objective of the settings found, in steps, on the tuning seeds"),
    ] = None
    sampler: Annotated[str | None, Field(max_length=40)] = None
    trials: Annotated[int | None, Field(ge=1, description="settings that were tried")] = None
    planned: Annotated[int | None, Field(ge=1, description="settings that were to be tried")] = None
    seeds: Annotated[str | None, Field(max_length=10_000, description="as --seeds reads them")] = None
    runs: Annotated[int | None, Field(ge=1, description="of all trials together, a seed each")] = None
    budget: Annotated[
        str | None,
        Field(max_length=200, description="budget of the search; equal for models tuned together"),
    ] = None
    rungs: Annotated[
        tuple[tuple[int, int], ...] | None,
        Field(description="successive halving, in older records: settings and seeds of each rung"),
    ] = None
    regret: RegretRecord | None = None
    last: LastRoundRecord | None = None
    epochs: Annotated[int | None, Field(ge=1, description="of every trial")] = None
    steps: Annotated[int | None, Field(ge=0, description="environment steps of all trials together")] = None
    space: Annotated[dict[str, Any] | None, Field(description="values or range of every option")] = None
    versions: dict[str, str] = {}
    core_hours: Annotated[
        float | None, Field(ge=0, description="measured; differs from machine to machine")
    ] = None
    note: Annotated[str | None, Field(max_length=1000, description="facts beside the other fields")] = None
    on_protocol_seeds: Annotated[
        bool,
        Field(description="chosen on seeds that entries are judged by; always so where `seeds` has some"),
    ] = False

    @model_serializer(mode="wrap")
    def _without_unknown(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out unknown fields of later versions: hashes of older studies cover records without it."""
        content: dict[str, Any] = write(self)
        return {name: value for name, value in content.items() if name not in _LATER or value is not None}

    @model_validator(mode="before")
    @classmethod
    def _mark(cls, data: Any) -> Any:
        """Mark a record whose seeds are protocol seeds, whatever it says itself."""
        seeds = data.get("seeds") if isinstance(data, Mapping) else None
        numbers = re.findall(r"\d+", seeds) if isinstance(seeds, str) else []
        if any(int(number) < TUNING_SEEDS for number in numbers):
            return {**data, "on_protocol_seeds": True}
        return data


class EntryTuning(TuningRecord):
    """An entry's record of the tuning of its settings (`tuning` in `entry.json`)."""

    preset: Annotated[str | None, Field(description="where the record comes from")] = None
    changed: Annotated[
        tuple[str, ...], Field(description="options that --set changed afterwards, as SIDE.NAME")
    ] = ()

    def plain(self) -> dict[str, Any]:
        """Return the record in `entry.json`."""
        unknown = {name for name in ("runs", "budget", "rungs") if getattr(self, name) is None}
        return self.model_dump(mode="json", exclude=unknown)  # 0.1.0 reads records without these keys only


class PresetFile(options.Table):
    """A whole preset file."""

    format_version: Literal[1]
    algorithm: str
    model: str
    algorithm_options: dict[str, Any] = {}
    model_options: dict[str, Any] = {}
    tuning: TuningRecord | None = None


def load(path: Path) -> PresetFile:
    """Read a preset file."""
    return files.load(path, PresetFile, "preset file")


def require(preset: PresetFile, source: str, algorithm: str, model: str) -> None:
    """Raise OptionError unless a preset file is for this algorithm and this model."""
    for kind, expected, actual in (
        ("algorithm", preset.algorithm, algorithm),
        ("model", preset.model, model),
    ):
        if expected != actual:
            raise OptionError(
                f"preset file {source} holds settings for {kind} '{expected}', not for '{actual}': "
                f"write {expected}, or tune {actual}"
            )


def record_of(
    tuning: TuningRecord,
    source: str,
    chosen: Mapping[str, Mapping[str, Any]],
    values: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """Return an entry's record of the tuning of its preset, see `EntryTuning`.

    Parameters
    ----------
    source:
        The preset's name.
    chosen:
        Values of the preset by side (`algorithm`, `model`); a side without values is absent.
    values:
        Values of `--set` by side; the record names values that differ from the preset.
    """
    changed = sorted(
        f"{side}.{name}"
        for side, content in chosen.items()
        for name, value in values.get(side, {}).items()
        if content.get(name) != value
    )
    return EntryTuning(**tuning.model_dump(), preset=source, changed=tuple(changed)).plain()


def dumps(preset: PresetFile, comment: str = "") -> str:
    """Return a preset file's text; options that are not set (None) are left out."""
    content = _without_none(preset.model_dump(mode="json"))
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    return "".join(f"{line}\n" for line in lines) + tomli_w.dumps(content)


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    return value
