"""Tasks, presets and entries, and their identity."""
