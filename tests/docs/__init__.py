"""Tests of README and docs."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

DOCS = Path(__file__).parents[2] / "docs"


def load(name: str) -> ModuleType:
    """Import a module of docs, which is no package."""
    if str(DOCS) not in sys.path:
        sys.path.append(str(DOCS))
    return importlib.import_module(name)


def percent(value: float) -> str:
    """Write a share as the pages do."""
    return f"{100 * value:.0f}%"
