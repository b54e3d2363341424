"""Preset files: settings in TOML that `qrlsuite run --preset FILE.toml` reads, and how they were found.

A preset never decides what an entry is, its values do. But where it was found by tuning, the entry carries the
record of that, so that a reader of a leaderboard knows how much was spent on the settings.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
import tomli_w
from pydantic import BaseModel, ConfigDict, Field

from qrlsuite import options
from qrlsuite.errors import OptionError, TaskError, nearest

TUNING_SEEDS = 1_000_000
"""Seeds from here on are for tuning; protocol seeds lie below."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TuningRecord(_Table):
    """How settings were found, and what it took."""

    task: Annotated[str, Field(max_length=80)]
    objective: Literal["cell", "area"]
    value: Annotated[
        float, Field(ge=0, description="S_hat of the settings found, in steps, on the tuning seeds")
    ]
    sampler: Annotated[str, Field(max_length=40)]
    trials: Annotated[int, Field(ge=1, description="settings that were tried")]
    planned: Annotated[int, Field(ge=1, description="settings that were to be tried")]
    seeds: Annotated[str, Field(max_length=10_000, description="as --seeds reads them")]
    epochs: Annotated[int, Field(ge=1)]
    steps: Annotated[int, Field(ge=0, description="environment steps of all trials together")]
    space: Annotated[dict[str, Any], Field(description="what every option was chosen from")]
    versions: dict[str, str] = {}
    core_hours: Annotated[float, Field(ge=0, description="measured; differs from machine to machine")] = 0.0

    @property
    def on_protocol_seeds(self) -> bool:
        """Whether the settings were chosen on seeds that entries are judged by."""
        found = re.findall(r"\d+", self.seeds)
        return any(int(number) < TUNING_SEEDS for number in found)


class PresetFile(_Table):
    """A whole preset file."""

    format_version: Literal[1]
    algorithm: str
    model: str
    algorithm_options: dict[str, Any] = {}
    model_options: dict[str, Any] = {}
    tuning: TuningRecord | None = None


def load(path: Path) -> PresetFile:
    """Read a preset file.

    Raises
    ------
    TaskError
        If it cannot be read or is malformed; the message lists every problem.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise TaskError(f"preset file {path} cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise TaskError(f"preset file {path}: not valid TOML: {error}") from None
    try:
        return PresetFile.model_validate(data)
    except pydantic.ValidationError as error:
        raise TaskError(f"preset file {path}: {'; '.join(_lines(error))}") from None


def _lines(error: pydantic.ValidationError) -> list[str]:
    lines = []
    for item, line in zip(error.errors(include_url=False), options.validation_lines(error)):
        *parents, key = (str(part) for part in item["loc"])
        if item["type"] == "extra_forbidden":
            known = (TuningRecord if parents else PresetFile).model_fields
            where = f" in [{'.'.join(parents)}]" if parents else ""
            lines.append(f"unknown key '{key}'{where}{nearest(key, known)}")
        elif item["type"] == "missing":
            lines.append(f"missing key '{'.'.join([*parents, key])}'")
        else:
            lines.append(line)
    return lines


def require(preset: PresetFile, source: str, algorithm: str, model: str) -> None:
    """Raise OptionError unless a preset file is for this algorithm and this model."""
    for kind, wanted, given in (
        ("algorithm", preset.algorithm, algorithm),
        ("model", preset.model, model),
    ):
        if wanted != given:
            raise OptionError(
                f"preset file {source} holds settings for {kind} '{wanted}', not for '{given}': "
                f"write --{kind} {wanted}, or tune {given}"
            )


def record_of(
    preset: PresetFile, source: str, values: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any] | None:
    """Return what an entry keeps of the tuning of its preset; None for a preset written by hand.

    Parameters
    ----------
    values:
        What `--set` gave, by side (`algorithm`, `model`): where that differs from the preset, the record says so.
    """
    if preset.tuning is None:
        return None
    own = {"algorithm": preset.algorithm_options, "model": preset.model_options}
    changed = sorted(
        f"{side}.{name}"
        for side, content in own.items()
        for name, value in values.get(side, {}).items()
        if content.get(name) != value
    )
    record = preset.tuning.model_dump(mode="json")
    return {
        **record,
        "preset": source,
        "changed": changed,
        "on_protocol_seeds": preset.tuning.on_protocol_seeds,
    }


def dumps(preset: PresetFile, comment: str = "") -> str:
    """Return a preset file's text; options that are not set (None) are left out."""
    content = _without_none(preset.model_dump(mode="json"))
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    return "".join(f"{line}\n" for line in lines) + tomli_w.dumps(content)


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    return value
