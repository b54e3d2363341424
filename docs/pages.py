"""A hook of mkdocs: notebooks as pages with their stored output, results in the navigation, the table of statements.

Nothing is executed.
"""

from __future__ import annotations

import csv
import shutil
from html import escape
from pathlib import Path
from typing import Any

import nbformat
import yaml
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

LISTED = "Every study and board"
"""The section of the navigation with the pages of docs/results."""


class Notebook(File):
    """A notebook that mkdocs takes for a page in Markdown, so that links to it and in it are checked and translated."""

    def is_documentation_page(self) -> bool:
        """Return that it is a page."""
        return True


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the pages of results in the navigation, below the page that lists them, and link to the project's address."""
    citation = yaml.safe_load((Path(config.docs_dir).parent / "CITATION.cff").read_text())
    if address := citation.get("repository-code"):
        config.repo_url, config.repo_name = address, "Repository"
    (results,) = (item["Results"] for item in config.nav or [] if "Results" in item)
    (section,) = (item[LISTED] for item in results if LISTED in item)
    pages = sorted(f"results/{page.name}" for page in Path(config.docs_dir, "results").glob("*.md"))
    boards = [page for page in pages if page.startswith("results/board-")]
    studies = [page for page in pages if page not in (*boards, *section)]
    section += [{"Studies": studies}, {"Boards": boards}]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Let notebooks be pages."""
    for file in [file for file in files if file.src_uri.endswith(".ipynb")]:
        files.remove(file)
        files.append(
            Notebook(
                file.src_uri,
                file.src_dir,
                config.site_dir,
                config.use_directory_urls,
            )
        )
    return files


def on_page_read_source(page: Page, config: MkDocsConfig) -> str | None:
    """Return a notebook as Markdown; None for other pages."""
    if not isinstance(page.file, Notebook):
        return None
    cells = nbformat.read(page.file.abs_src_path, as_version=4).cells
    download = (
        f'<p><a href="{Path(page.file.src_uri).name}" download>Download this page as a notebook</a></p>'
    )
    return "\n\n".join([*(block for cell in cells for block in _blocks(cell)), download])


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put the table of the paper's statements where its page asks for it."""
    if page.file.src_uri != "statements.md":
        return markdown
    with Path(config.docs_dir, "statements.csv").open(newline="") as file:
        return markdown.replace("<!-- statements -->", _table(list(csv.DictReader(file))))


def _table(rows: list[dict[str, str]]) -> str:
    """Return the statements as a table, behind a field to search them."""
    kinds = "".join(f"<option>{kind}</option>" for kind in sorted({row["kind"] for row in rows}))
    columns = ("paper", "statement", "verdict", "seeds", "evidence", "error")
    lines = [" | ".join(columns), "|".join(["---"] * len(columns))]
    for row in rows:
        verdict = f'<span data-kind="{row["kind"]}">{row["verdict"]}</span>'
        lines.append(" | ".join({**row, "verdict": verdict}[name] for name in columns))
    return (
        '<p id="statements"><input type="search" placeholder="Search" aria-label="Search statements"> '
        f'<select aria-label="Verdict"><option value="">every verdict</option>{kinds}</select> <output></output></p>'
        "\n\n" + "".join(f"| {line} |\n" for line in lines)
    )


def on_post_build(config: MkDocsConfig) -> None:
    """Put the notebooks beside their pages."""
    for notebook in Path(config.docs_dir).rglob("*.ipynb"):
        shutil.copy(
            notebook,
            config.site_dir / notebook.relative_to(config.docs_dir),
        )


def _blocks(cell: Any) -> list[str]:
    if cell.cell_type != "code":
        return [cell.source]
    printed = "".join(output.text for output in cell.outputs if output.output_type == "stream")
    shown = [_shown(output.data, cell.source) for output in cell.outputs if output.output_type != "stream"]
    return [
        f"```python\n{cell.source}\n```",
        *([_shown({"text/plain": printed}, "")] if printed else []),
        *shown,
    ]


def _shown(data: Any, source: str) -> str:
    """Return an output as HTML."""
    if "image/png" in data:
        alt = escape(source.splitlines()[-1])
        return f'<p><img alt="{alt}" src="data:image/png;base64,{data["image/png"].strip()}"></p>'
    html = data.get("text/html") or f"<pre>{escape(data['text/plain'])}</pre>"
    return f'<div class="output">{html}</div>'
