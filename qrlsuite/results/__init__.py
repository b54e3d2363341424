"""What is on disk: results folders, checkpoints and claims, and what can be read from them."""
