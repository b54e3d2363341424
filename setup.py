"""What pyproject.toml leaves to be computed: the project's addresses, and the text that an index shows.

The project's address is `repository-code` of CITATION.cff, and nowhere else. With it, links of the text lead to the
release's files. Without it they are plain text, for they lead nowhere from an index's page.
"""

import re
import tomllib
from pathlib import Path

from setuptools import setup

HERE = Path(__file__).parent
LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|#)([^)\s]+)\)")


def described(text: str, address: str | None, version: str) -> str:
    """Return README with links that an index's page can follow, or with their words."""

    def link(found: re.Match[str]) -> str:
        picture, words, target = found.groups()
        if address is None:
            return f"*Picture: {words}*" if picture else words
        return f"{picture}[{words}]({address}/{'raw' if picture else 'blob'}/v{version}/{target})"

    return LINK.sub(link, text)


if __name__ == "__main__":
    stated = re.search(r'^repository-code: "(.+)"$', (HERE / "CITATION.cff").read_text(), re.MULTILINE)
    address = stated.group(1).rstrip("/") if stated else None
    version = tomllib.loads((HERE / "pyproject.toml").read_text())["project"]["version"]
    setup(
        long_description=described((HERE / "README.md").read_text(), address, version),
        long_description_content_type="text/markdown",
        project_urls={"Repository": address} if address else {},
    )
