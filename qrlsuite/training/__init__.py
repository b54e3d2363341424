"""Training a group of seeds in one process, and what trained agents score."""
