"""A leaderboard as one HTML page that works offline: `render(board)`.

The page is made from the templates, the style and the scripts in this folder; nothing else is in it.
"""

from qrlsuite.leaderboard.report.page import render

__all__ = ["render"]
