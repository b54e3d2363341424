"""Ranking of entries by significant outperformance, and its presentation."""
