"""Tuning: choosing settings by how fast they learn, on seeds that no entry is judged by.

- `space`: search grids, and the settings that they span.
- `samplers`: in which order settings are tried: a whole grid, parts of it, or a model's proposals.
- `objective`: what a trial is worth.
- `search`: trial by trial, each an ordinary set of runs; and the preset file that comes out.
- `bayesian`: until the expected regret is small, by a `surrogate`: models' searches made equal.
"""
