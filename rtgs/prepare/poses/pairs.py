"""Which photos are compared with which: all, neighbours in a sequence, or the most similar ones (retrieval)."""

from __future__ import annotations

import itertools

import numpy as np

from rtgs.prepare.settings import MatchingSettings

_SAMPLE = 20_000  # descriptors the centres of the image signature are learnt from
_ROUNDS = 10  # of k-means


def choose_strategy(count: int, video: bool, settings: MatchingSettings) -> tuple[str, str]:
    """How pairs are chosen for ``count`` photos, and why, in words."""
    if settings.pairs != "auto":
        return settings.pairs, "as sfm.matching.pairs asks"
    if count <= settings.exhaustive_up_to:
        return "exhaustive", f"{count} photos are no more than {settings.exhaustive_up_to}"
    if video:
        return "sequential", f"{count} frames of a video, more than {settings.exhaustive_up_to}"
    return "retrieval", f"{count} photos are more than {settings.exhaustive_up_to}"


def exhaustive_pairs(count: int) -> list[tuple[int, int]]:
    """Every pair (i, j), i < j."""
    return list(itertools.combinations(range(count), 2))


def sequential_pairs(count: int, overlap: int) -> list[tuple[int, int]]:
    """Each with the next ``overlap``, and with those at distances 2, 4, 8 ... up to 2^overlap."""
    steps = sorted({*range(1, overlap + 1), *(2**power for power in range(overlap + 1))})
    return [(first, first + step) for first in range(count) for step in steps if first + step < count]


def retrieval_pairs(signatures: np.ndarray, neighbours: int) -> list[tuple[int, int]]:
    """Each photo with its ``neighbours`` most similar ones by unit signatures (N, D); name order breaks ties."""
    likeness = signatures @ signatures.T
    np.fill_diagonal(likeness, -np.inf)
    near = np.argsort(-likeness, axis=1, kind="stable")[:, : min(neighbours, len(signatures) - 1)]
    pairs = {(min(i, int(j)), max(i, int(j))) for i in range(len(signatures)) for j in near[i]}
    return sorted(pairs)


def learn_words(samples: np.ndarray, words: int, seed: int) -> np.ndarray:
    """Centres (K, D) float32 of descriptors (N, D) by k-means, the same for the same seed."""
    rng = np.random.default_rng(seed)
    samples = np.asarray(samples, dtype=np.float32)
    if len(samples) > _SAMPLE:
        samples = samples[rng.choice(len(samples), _SAMPLE, replace=False)]
    words = min(words, len(samples))
    centers = samples[rng.choice(len(samples), words, replace=False)].copy()
    for _ in range(_ROUNDS):
        nearest = _nearest(samples, centers)
        for word in range(words):
            members = samples[nearest == word]
            if len(members):
                centers[word] = members.mean(axis=0)
    return centers


def _nearest(samples: np.ndarray, centers: np.ndarray) -> np.ndarray:
    return np.argmin((centers**2).sum(axis=1) - 2 * samples @ centers.T, axis=1)


def signature(descriptors: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """VLAD of one photo (Jegou et al. 2010, "Aggregating local descriptors into a compact image representation"):
    the residuals of its descriptors (N, D) summed per centre, each row and then the whole brought to unit length."""
    result = np.zeros(centers.shape, dtype=np.float32)
    if len(descriptors):
        values = np.asarray(descriptors, dtype=np.float32)
        nearest = _nearest(values, centers)
        np.add.at(result, nearest, values - centers[nearest])
        result /= np.maximum(np.linalg.norm(result, axis=1, keepdims=True), 1e-6)
    return result.ravel() / max(float(np.linalg.norm(result)), 1e-6)
