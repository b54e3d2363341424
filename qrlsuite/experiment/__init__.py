"""Tasks, presets and entries: what is run, and its identity."""
