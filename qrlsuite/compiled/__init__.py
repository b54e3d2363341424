"""Compiled loops (numba): vectors of lanes, the cache of compiled code, and the layers of networks."""
