"""Another Python with a method that only it has, and what to ask it."""

import sys
from pathlib import Path

import pytest

import lodbench
from lodbench.harness.conformance.trial import make_trial
from lodbench.methods.registry import make_method

# A method whose package only the other Python finds: it asks for a little of everything.
SHAKE = """
from dataclasses import dataclass
import numpy as np
from lodbench.errors import QueryFault
from lodbench.methods.fits import nothing_fits
from lodbench.methods import Estimate
from lodbench.rendering import IouFit
from lodbench.segmentation import binary_mask
import time
from threadpoolctl import threadpool_info

def blas_threads():
    return max(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")

@dataclass(frozen=True)
class ShakeParams:
    name: str = "shake"
    tries: int = 8
    mood: str = "fine"

class Shake:
    name = "shake"
    params_type = ShakeParams
    requires = frozenset({"mask"})

    def __init__(self, params):
        self.params = params

    def prepare(self, city_map, references, workspace):
        (workspace.folder / "blas").write_text(str(blas_threads()))
        if self.params.mood == "slow":
            time.sleep(1.0)
        if self.params.mood == "unready" and not (workspace.folder / "ready").exists():
            raise QueryFault("not yet")

    def localize(self, query, city_map, streams):
        print("what is printed is no message")
        if self.params.mood == "dies" and query.name.endswith("0.png"):
            raise RuntimeError("no more")
        if self.params.mood == "lost":
            raise nothing_fits("no view fits")
        if not binary_mask(query.mask, 64, 48).any():
            raise QueryFault("the mask holds no building")
        camera = query.camera.scaled(64, 48)
        moves = streams("moves", 0).normal(scale=3.0, size=(self.params.tries, 3))
        rotations = np.repeat(query.prior.rotation[None], len(moves), axis=0)
        fit = IouFit(binary_mask(query.mask, 64, 48))
        scores = city_map.fit(camera, rotations, query.prior.center + moves, fit)
        best = int(np.argmax(scores))
        seen = city_map.edges(camera, rotations[:1], query.prior.center[None], crease_deg=20.0)
        told = {"edges": (float(len(seen[0].points)), float(city_map.scene.num_buildings))}
        told["blas"] = (float(blas_threads()),)
        return Estimate(query.prior.shifted(moves[best]), float(scores[best]), trace=told)
"""


@pytest.fixture(scope="session")
def elsewhere(tmp_path_factory) -> str:
    """Another Python: this one, with a package that is installed nowhere else."""
    folder = tmp_path_factory.mktemp("elsewhere")
    (folder / "shake_method.py").write_text(SHAKE)
    info = folder / "shake-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: shake\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[lodbench.methods]\nshake = shake_method:Shake\n")
    python = folder / "python"
    own = Path(lodbench.__file__).parents[1]  # this lodbench, wherever another one is installed
    python.write_text(f'#!/bin/sh\nPYTHONPATH="{folder}:{own}" exec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    return str(python)


@pytest.fixture(scope="session")
def trial(tmp_path_factory):
    return make_trial(tmp_path_factory.mktemp("trial"), make_method("lodlocv2"))
