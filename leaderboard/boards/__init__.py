"""Boards and comparisons: who is ahead of whom, by steps, by costs, by scores, and over several tasks."""
