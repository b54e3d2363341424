"""Engines: they run groups of seeds, here or on a cluster. All results are in the results folder."""
