"""Entries as files: found, read, published, imported and checked."""

from pathlib import Path

PLANS = Path(__file__).parents[1] / "plans"
"""The studies with looks that come with the suite: `NAME/plan.toml`, see `published_studies`."""
