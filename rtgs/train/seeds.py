"""One seed, one independent generator per purpose."""

from __future__ import annotations

import hashlib

import torch


def seed_for(seed: int, purpose: str) -> int:
    """A seed of its own for ``purpose`` ("initialise", "views", ...), so that no two uses share a random stream."""
    return int.from_bytes(hashlib.sha256(f"{seed}/{purpose}".encode()).digest()[:7], "little")


def generator_for(seed: int, purpose: str) -> torch.Generator:
    """A torch generator of its own for one purpose, so that no two uses share a random stream.

    Parameters
    ----------
    seed : int
        Of the run.
    purpose : str
        Any word; methods are made with ``"initialise"``.

    Returns
    -------
    torch.Generator
        Seeded by :func:`seed_for`.
    """
    return torch.Generator().manual_seed(seed_for(seed, purpose))
