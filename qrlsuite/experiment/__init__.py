"""What is to be run, and its identity: tasks, presets and entries."""
