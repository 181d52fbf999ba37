"""Tools that measure: ``speed`` and ``quality``; docs/benchmarks.md lists every one. ``common`` is what they share."""
