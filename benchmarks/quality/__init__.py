"""How good: pictures, poses, masks and meshes against what is known of them (docs/benchmarks.md)."""
