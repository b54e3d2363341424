"""Entries as files: found, read, published, imported and checked."""
