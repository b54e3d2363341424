"""Results on disk: folders, checkpoints, claims, and readers of them."""
