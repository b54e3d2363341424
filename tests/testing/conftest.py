"""Commands that checks start are forks here: that they are processes of their own is not the point."""

from __future__ import annotations

import subprocess
from types import SimpleNamespace
from typing import Any

import pytest

from qrlsuite.testing import study
from tests.commands import qrlsuite


@pytest.fixture(autouse=True)
def _forked(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(command: list[str], env: dict[str, str], **rest: Any) -> subprocess.CompletedProcess[str]:
        return qrlsuite(*command[command.index("qrlsuite") + 1 :], env=env)

    monkeypatch.setattr(study, "subprocess", SimpleNamespace(run=run))
