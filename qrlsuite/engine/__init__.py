"""Where groups of seeds run. Engines only decide that; the results folder is the one source of truth."""
