"""Readers of strangers' files against mutated files: accepted and valid, or a documented error that names the file."""
