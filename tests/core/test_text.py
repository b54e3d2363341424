"""Numbers as tables, pictures and messages write them."""

from __future__ import annotations

from qrlsuite.results import text


def test_steps_have_four_digits_at_most() -> None:
    steps = (0, 60, 999, 62_000, 58_150, 107_900, 1_000_000, 1_254_000, 8_600_000_000)
    written = ["0", "60", "999", "62k", "58.15k", "107.9k", "1M", "1.254M", "8.6 billion"]
    assert [text.steps_text(count) for count in steps] == written
    assert text.steps_text(58_234.5, digits=3) == "58.2k"


def test_times_are_in_the_unit_that_fits() -> None:
    seconds = (80, 1800, 9000, 259_200)
    assert [text.duration(time) for time in seconds] == ["80 s", "30 min", "2.5 h", "3.0 days"]
    assert [text.hours_text(hours) for hours in (0.0441, 1.23, 1234.4)] == ["0.044", "1.2", "1,234"]


def test_sizes_and_counts() -> None:
    assert [text.size_text(size) for size in (0, 812, 9_300, 42_000_000)] == [
        "0 B",
        "812 B",
        "9.3 kB",
        "42 MB",
    ]
    assert text.counted(1, "entry") == "1 entry"
    assert text.counted(1200, "entry") == "1,200 entries"
    assert text.counted(2, "process", "processes") == "2 processes"
