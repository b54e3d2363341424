"""Which versions of the suite a plugin works with: what its distribution requires of `qrlsuite`, checked at loading.

A plugin says it where every Python package does, in its `pyproject.toml`::

    dependencies = ["qrlsuite>=0.1,<0.2"]

pip honors it when the plugin is installed, and lets a later upgrade of the suite break it; so it is read again
before the plugin is imported. Hooks and specs may change when the first two numbers of the version change.
"""

from __future__ import annotations

from importlib import metadata

import qrlsuite
from qrlsuite.errors import PluginError


def required(distribution: metadata.Distribution | None) -> str:
    """Return the versions of the suite that a distribution requires, such as `"<0.2,>=0.1"`; `""` for any.

    Raises
    ------
    PluginError
        If what it requires cannot be read.
    """
    if distribution is None or distribution.name == "qrlsuite":
        return ""
    from packaging.requirements import InvalidRequirement, Requirement  # 50 ms: only where there are plugins

    stated = []
    for line in distribution.requires or []:
        try:
            requirement = Requirement(line)
            applies = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        except (InvalidRequirement, ValueError) as error:
            if line.lower().startswith("qrlsuite"):
                raise PluginError(
                    f"distribution '{distribution.name}' requires {line!r}, which cannot be read: {error}"
                ) from error
            continue
        if applies and requirement.name.lower().replace("_", "-") == "qrlsuite":
            stated += [str(specifier) for specifier in requirement.specifier]
    return ",".join(sorted(stated))


def check(distribution: metadata.Distribution | None, version: str | None = None) -> None:
    """Refuse a distribution that does not work with this version of the suite.

    Raises
    ------
    PluginError
        Naming the distribution, what it requires, what there is, and what to type.
    """
    needs = required(distribution)
    if not needs or distribution is None:
        return
    from packaging.specifiers import SpecifierSet

    ours = qrlsuite.__version__ if version is None else version
    if not SpecifierSet(needs).contains(ours, prereleases=True):
        raise PluginError(
            f"distribution '{distribution.name}' {distribution.version} requires qrlsuite{needs}, and this is "
            f"qrlsuite {ours}: pip install --upgrade {distribution.name}, or pip install 'qrlsuite{needs}'"
        )
