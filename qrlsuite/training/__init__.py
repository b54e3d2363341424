"""Trains a group of seeds in one process, and evaluates trained agents."""
