"""A leaderboard as one HTML page that works offline: `render(board)`.

The page is made from templates in this folder, two style and script files of our own and plotly.js's basic
bundle (`plotly-basic.min.js`, version 3.7.0 as published in the npm package `plotly.js-basic-dist-min`, MIT
license beside it; the Python package of plotly ships only the full bundle of 4.8 MB).
"""

from qrlsuite.leaderboard.report.page import render

__all__ = ["render"]
