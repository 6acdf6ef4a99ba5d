"""Methods that answer as a test sets them, and runs of them."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lodbench.errors import QueryFault
from lodbench.harness import RunSettings, run_method
from lodbench.methods import Estimate
from lodbench.methods.protocol import FlightEstimate
from lodbench.segmentation.masks import NoMask, NoMaskParams

NAMES = ["view_00.png", "view_01.png", "view_02.png"]


@dataclass
class Scripted:
    """Answers the prior, unless set to raise; notes its queries."""

    name = "scripted"
    requires = frozenset()
    raises: dict[str, Exception] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)

    def localize(self, query, city_map, streams):
        assert query.building_probability is None
        self.asked.append(query.name)
        if query.name in self.raises:
            raise self.raises[query.name]
        city_map.render(query.camera, query.prior)
        return Estimate(query.prior, 1.0, hypotheses=99)


@dataclass
class Batched(Scripted):
    """The same, two at a time."""

    batch_size = 2
    batches: list[list[str]] = field(default_factory=list)

    def localize_batch(self, queries, city_map, streams):
        self.batches.append([query.name for query in queries])
        found = []
        for query, each in zip(queries, streams, strict=True):
            try:
                found.append(self.localize(query, city_map, each))
            except QueryFault as fault:
                found.append(fault)
        return found


@dataclass
class Flying(Scripted):
    """The same, a whole flight at a time."""

    flights: list[list[str]] = field(default_factory=list)

    def localize_flight(self, queries, city_map, streams):
        self.flights.append([query.name for query in queries])
        return FlightEstimate([Estimate(query.prior, 1.0) for query in queries], {"lost": []})


@dataclass
class Preparing(Scripted):
    """Reads weights, and prepares the height of the city."""

    weights: Path | None = None
    made: list[str] = field(default_factory=list)
    top_m: float | None = None

    def weight_files(self):
        return [] if self.weights is None else [self.weights]

    def prepare(self, city_map, references, workspace):
        def make(path):
            self.made.append(path.suffix)
            np.save(path, city_map.scene.vertices[:, 2].max())

        self.top_m = float(np.load(workspace.part("top.npy", make)))

    def localize(self, query, city_map, streams):
        return Estimate(query.prior, self.top_m)


def run(method, dataset, tmp_path, **more):
    settings = RunSettings(tmp_path / "runs", {"method": {"name": method.name}}, threads=1, **more)
    return run_method(method, dataset, NoMask(NoMaskParams()), settings)


def failures(run) -> list[str]:
    return [found.failure for found in run.predictions.values()]
