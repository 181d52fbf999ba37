"""How fast: each module is a command that prints figures and ends with a JSON object (docs/benchmarks.md)."""
