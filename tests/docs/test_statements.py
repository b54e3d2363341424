"""docs/statements.csv is what `make statements` computes from the published entries and plans."""

from __future__ import annotations

from tests.docs import DOCS, load

statements = load("statements")
pages = load("pages")


def test_the_table_is_what_the_published_entries_and_plans_say() -> None:
    rows = statements.table()
    assert len(rows) > 100
    assert statements.computed(rows) == rows, "run `make statements`"
    assert statements.summary(rows) in " ".join((DOCS / "paper.md").read_text().split())


def test_a_stale_row_is_computed_anew() -> None:
    [row] = [row for row in statements.table() if row["statement"] == "Networks improve up to width 64"]
    match = statements.PAIR.match(row["evidence"])
    assert statements.pair({**row, "verdict": "does not hold"}, match)["verdict"] == row["verdict"]
    assert statements.pair({**row, "expected": "no fewer"}, match)["verdict"] == "does not hold"


def test_every_statement_is_in_the_pages_table() -> None:
    rows = statements.table()
    table = pages._table(rows)
    assert table.count("data-kind=") == len(rows)
    assert all(row["evidence"] in table and row["kind"] == statements.kind_of(row["verdict"]) for row in rows)
