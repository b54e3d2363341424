"""Studies: named sets of entries that answer one question together."""
