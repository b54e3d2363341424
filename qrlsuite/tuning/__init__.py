"""Tuning: choosing settings by how fast they learn, on seeds that no entry is judged by.

- `space`: search grids, and the settings that they span.
- `samplers`: the order of settings: a whole grid, parts of it, or a model's proposals.
- `objective`: the merit of a trial.
- `search`: trial by trial, each an ordinary set of runs; and the preset file that comes out.
- `bayesian`: until the expected regret is small, by a `surrogate`: models' searches made equal.
"""
