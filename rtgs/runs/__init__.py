"""Finished runs: the record of a run folder, and its model read back out of the store."""
