"""The notation of an entry, `[ALGORITHM] MODEL NAME=VALUE ... [preset=FILE]`, printed by boards and read by commands.

Whatever else has a name and options is written in the same way: an engine (`slurm partition=gpu`), a circuit backend
(`qiskit shots=1000`), a sampler (`random trials=50`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from qrlsuite.errors import OptionError
from qrlsuite.options import Setting, parse_setting, parse_value

PRESET = "preset"
"""A name that is no option: `preset=FILE.toml`, or a preset of the task."""

START = "from"
"""The other one: `from=TASK/ENTRY:EPOCHS`, the entry and epoch of the agents with which training begins."""

_QUOTED = r'"(?:\\.|[^"\\])*"' + r"|'(?:\\.|[^'\\])*'"
_PIECE = re.compile(_QUOTED + r"|.", re.DOTALL)
_CLOSING = {"[": "]", "{": "}"}


@dataclass(frozen=True)
class Written:
    """An entry in its written form; `qrlsuite.experiment.entry.resolve` makes an entry of it.

    Attributes
    ----------
    algorithm, preset, start:
        None where they are not written.
    """

    model: str
    algorithm: str | None = None
    settings: tuple[Setting, ...] = ()
    preset: str | None = None
    start: str | None = None

    def given(
        self, algorithm: str | None = None, settings: tuple[Setting, ...] = (), preset: str | None = None
    ) -> Written:
        """Return it with further settings, and with an algorithm and a preset if the text lacks them."""
        for name, written, other in (
            ("algorithm", self.algorithm, algorithm),
            (PRESET, self.preset, preset),
        ):
            if None not in (written, other) and written != other:
                raise OptionError(f"{name} '{other}', and '{written}' in the entry: give one of them")
        return replace(
            self,
            algorithm=self.algorithm or algorithm,
            settings=(*self.settings, *settings),
            preset=self.preset or preset,
        )


def parse_entry(text: str) -> Written:
    """Read `[ALGORITHM] MODEL NAME=VALUE ... [preset=FILE]`.

    Raises
    ------
    OptionError
        If it does not begin with one or two names, a quote or bracket is open, or an option has no name.

    >>> parse_entry("ddqn mlp width=16 lr=1e-3").settings[0].value
    16
    """
    names, settings = _parse(text, f"entry '{text}': ")
    if not 1 <= len(names) <= 2:
        raise OptionError(
            f"entry '{text}': write [ALGORITHM] MODEL NAME=VALUE ..., for example 'mlp width=64'"
        )
    own = {
        each.name: str(each.value) for each in settings if each.side is None and each.name in (PRESET, START)
    }
    return Written(
        model=names[-1],
        algorithm=names[0] if len(names) == 2 else None,
        settings=tuple(each for each in settings if each.side is not None or each.name not in own),
        preset=own.get(PRESET),
        start=own.get(START),
    )


def joined(words: Sequence[str]) -> str:
    """Return words of a command line as one text; a script's command and curve are one of them each, with white space.

    >>> joined(["script", "ppo-mine", "command=python ppo.py --seed {seed}"])
    "script ppo-mine command='python ppo.py --seed {seed}'"
    """
    whole = "command=", "curve="
    return " ".join(write_setting(*word.split("=", 1)) if word.startswith(whole) else word for word in words)


def parse_named(text: str, prefix: str = "") -> tuple[str, dict[str, Any]]:
    """Read a name and its options: `slurm partition=gpu time=2:00:00`.

    Parameters
    ----------
    prefix:
        Text before it in the user's words, for messages.
    """
    names, settings = _parse(text, f"{prefix}'{text}': ")
    if len(names) != 1 or any(setting.side for setting in settings):
        raise OptionError(f"{prefix}'{text}': write a name and its options, NAME OPTION=VALUE ...")
    return names[0], {setting.name: setting.value for setting in settings}


def _parse(text: str, prefix: str) -> tuple[list[str], list[Setting]]:
    """Return the words at the beginning without `=`, and the settings after them."""
    words = split(text)
    count = next((index for index, word in enumerate(words) if "=" in word), len(words))
    settings = [parse_setting(word, prefix) for word in words[count:]]
    first = {(each.side, each.name): repr(each.value) for each in reversed(settings)}
    for each in settings:
        if repr(each.value) != first[each.side, each.name]:
            raise OptionError(f"{prefix}{each.full_name} is given twice: leave one out")
    return words[:count], settings


def split(text: str) -> list[str]:
    """Split at white space, but not within the quotes and brackets of a value.

    >>> split("mlp widths=[64, 64] title='two layers'")
    ['mlp', 'widths=[64, 64]', "title='two layers'"]
    """
    words: list[str] = []
    rest = text.strip()
    while rest:
        word = re.match(r"[^\s=]*=?", rest)
        assert word is not None  # it matches anything, the empty text too
        end = _value_end(rest, word.end(), text) if word.group().endswith("=") else word.end()
        words.append(rest[:end])
        rest = rest[end:].lstrip()
    return words


def _value_end(text: str, start: int, whole: str) -> int:
    """Return where the value ends that begins at `start`."""
    open_brackets: list[str] = []
    structured = text[start : start + 1] in ("'", '"', *_CLOSING)
    end = start
    while end < len(text):
        piece = _PIECE.match(text, end) if structured else None
        part = text[end] if piece is None else piece.group()
        if structured and part in "'\"":
            raise OptionError(f"'{whole}': a quote is open: {text[end:]}")
        if part.isspace() and not open_brackets:
            break
        if structured and part in _CLOSING:
            open_brackets.append(_CLOSING[part])
        elif open_brackets and part == open_brackets[-1]:
            open_brackets.pop()
        end += len(part)
    if open_brackets:
        raise OptionError(f"'{whole}': '{open_brackets[-1]}' is missing: {text[start:]}")
    return end


def write_setting(name: str, value: Any) -> str:
    """Write `name=value` as `parse_entry` reads it.

    >>> write_setting("activation", "relu"), write_setting("title", "two layers")
    ('activation=relu', "title='two layers'")
    """
    return f"{name}={write_value(value)}"


def write_value(value: Any) -> str:
    """Write a plain value as short as it can be read again."""
    candidates = (str(value), repr(value), _toml(value))
    return next((text for text in candidates if _reads_as(text, value)), candidates[-1])


def _reads_as(text: str, value: Any) -> bool:
    try:
        words = split(f"a={text}")
    except OptionError:
        return False
    return words == [f"a={text}"] and repr(parse_value(text)) == repr(value)


def _toml(value: Any) -> str:
    """Write a value in one line of TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_toml(str(key))} = {_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
