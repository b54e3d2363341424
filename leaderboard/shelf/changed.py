"""Which published entries and studies a checkout changes: git is asked without a shell, and no name is believed.

A change that others propose has folders of any name, and where a name reaches a shell, it is a program. So git is
started with a list of words, its answer is split at null bytes, and a name that no published file has is refused.
"""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.leaderboard.shelf.published import AGENTS, CURVES, SEEDS
from qrlsuite.studies.looks import FILE, LOG

OF_ENTRIES = "leaderboard/entries", "leaderboard/unranked"
OF_STUDIES = "leaderboard/plans", "leaderboard/family"
PLACES = *OF_ENTRIES, *OF_STUDIES
"""A repository's folders of published files."""

_NAME = re.compile(r"[a-z0-9][a-z0-9+._-]*")
_OF_ENTRY, _OF_STUDY = ("entry.json", CURVES, SEEDS, AGENTS), (FILE, LOG)


def changed(base: str, checkout: Path) -> tuple[list[Path], list[Path]]:
    """Return the folders of entries, and of studies, in which a checkout differs from a commit; both sorted.

    Files that git does not track yet count; files that it ignores do not. Removed entries and removed files of entries
    count, too: nobody removes published files unseen.

    Parameters
    ----------
    base:
        A commit, by any of its names in git: `origin/main`, `HEAD~1`.
    checkout:
        The repository's folder, or one below it.
    """
    root = Path(_git(checkout, "rev-parse", "--show-toplevel").removesuffix("\n"))
    commit = _commit(base, root)
    names = _git(root, "diff", "-z", "--name-only", "--no-renames", "--no-ext-diff", commit, "--", *PLACES)
    names += _git(root, "ls-files", "-z", "--others", "--exclude-standard", "--", *PLACES)
    folders = set()
    for name in sorted(filter(None, names.split("\0"))):
        path, problem = root / name, _problem(root, name)
        if problem and os.path.lexists(path):
            raise QrlSuiteError(f"{name!r}: {problem}; refused, nothing was verified")
        if not problem:
            folders.add(path.parent)
    studies = {folder for folder in folders if folder.parent in [root / place for place in OF_STUDIES]}
    return sorted(folders - studies), sorted(studies)


def _commit(base: str, root: Path) -> str:
    problem = f"--base {base!r} names no commit here: write one, such as origin/main or HEAD~1"
    if base.startswith("-"):  # git would take it for an option
        raise OptionError(problem)
    try:
        return _git(root, "rev-parse", "--verify", f"{base}^{{commit}}").strip()
    except (QrlSuiteError, ValueError):  # a null byte in it
        raise OptionError(problem) from None


def _git(folder: Path, *words: str) -> str:
    """Return git's output; bytes that are no UTF-8 become surrogates, as in any path."""
    try:
        done = subprocess.run(["git", "-C", str(folder), *words], capture_output=True, check=True)
    except OSError as error:
        raise QrlSuiteError(f"git cannot be started: {error.strerror or error}") from None
    except subprocess.CalledProcessError as error:
        said = " ".join(os.fsdecode(error.stderr).split())[:200]
        raise QrlSuiteError(f"git {words[0]} failed in {folder}: {said}") from None
    return os.fsdecode(done.stdout)


def _problem(root: Path, name: str) -> str | None:
    """Return why a path is not a published file's path, None if it is one."""
    place = next(place for place in PLACES if f"{name}/".startswith(f"{place}/"))
    parts = name[len(place) + 1 :].split("/")
    strange = next((part for part in parts if not _NAME.fullmatch(part)), None)
    if strange:
        return f"{strange!r} is no valid name: use a-z, 0-9, '+', '.', '_' and '-'"
    if any((root / part).is_symlink() for part in [name, *map(str, Path(name).parents)]):
        return "it is a link, or behind one"
    of_study = place in OF_STUDIES
    files = {
        2: () if of_study else _OF_ENTRY,
        3: _OF_ENTRY if of_study else (),
        1: _OF_STUDY if of_study else (),
    }
    if parts[-1] in files.get(len(parts) - 1, ()):
        return None
    entry = f"TASK/ENTRY/ with {', '.join(_OF_ENTRY)}"
    return f"{place} holds {f'NAME/ with {FILE}, {LOG} and NAME/{entry}' if of_study else entry} alone"
