"""Loops that numba compiles: vectors of lanes, and the cache of compiled code."""
