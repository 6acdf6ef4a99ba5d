"""Random streams named by what they are for, never by the worker that draws from them."""

from __future__ import annotations

import hashlib

import numpy as np


def random_stream(seed: int, *names: str | int) -> np.random.Generator:
    """Returns the generator of a seed and a path of names: (dataset, query, stage, step).

    The same path gives the same numbers on every machine and in every order of work; different
    paths give independent numbers (Philox keyed by a 128-bit hash).
    """
    path = "\x1f".join([str(seed), *(f"{type(name).__name__}:{name}" for name in names)])
    key = int.from_bytes(
        hashlib.blake2b(path.encode(errors="surrogatepass"), digest_size=16).digest(), "little"
    )
    return np.random.Generator(np.random.Philox(key=key))
