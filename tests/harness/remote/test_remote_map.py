"""The map as a method in another process has it: portions, counts, and what is refused."""

import numpy as np
import pytest

from lodbench.errors import LodbenchError
from lodbench.geometry import Camera
from lodbench.harness.remote import child as child_module
from lodbench.harness.remote.child import RemoteMap
from lodbench.harness.remote.method import answered
from lodbench.harness.remote.wire import KINDS, packed
from lodbench.methods.conformance.trial import streams_of
from lodbench.rendering import IouFit


class Here:
    """Stands for the pipe: what is asked is answered in this process, and noted."""

    def __init__(self, city_map) -> None:
        self.city_map, self.asked = city_map, []

    def ask(self, *words):
        self.asked.append(words)
        return answered(list(words), None, self.city_map, None)


FAR = {"name": "", "threads": 1, "is_textured": False}


@pytest.mark.parametrize("kind", [*sorted(KINDS - {"render"}), "fit"])
def test_many_poses_are_asked_for_some_at_a_time(kind, trial, monkeypatch):
    camera, city_map = trial.queries[0].camera.scaled(80, 60), trial.city_map
    poses = [query.prior for query in trial.queries] * 2
    asked = np.stack([p.rotation for p in poses]), np.stack([p.center for p in poses])
    mask = np.zeros((60, 80), bool)
    mask[20:40, 30:60] = True
    more = {"counts": [mask], "fit": [IouFit(mask)]}.get(kind, [])
    city_map.usage.take()
    monkeypatch.setattr(child_module, "_PORTION_BYTES", 40 if kind == "counts" else 1)
    pipe = Here(city_map)
    found = getattr(RemoteMap(pipe, FAR), kind)(camera, *asked, *more)
    assert len(pipe.asked) == (3 if kind == "counts" else 6)
    assert city_map.usage.total == 6
    assert packed(found) == packed(getattr(city_map, kind)(camera, *asked, *more))
    nothing = getattr(RemoteMap(pipe, FAR), kind)(camera, asked[0][:0], asked[1][:0], *more)
    assert packed(nothing) == packed(getattr(city_map, kind)(camera, asked[0][:0], asked[1][:0], *more))


def test_a_grid_of_any_size_is_drawn(trial, monkeypatch):
    """200,000 poses, 6.9 GB of silhouettes: more than goes over the pipe at a time."""
    largest = 0

    def silhouettes(camera, rotations, centers):
        nonlocal largest
        largest = max(largest, len(centers))
        return np.zeros((len(centers), 1, 1), np.uint64)

    monkeypatch.setattr(trial.city_map.scorer, "silhouettes", silhouettes)
    method_map = RemoteMap(Here(trial.city_map), FAR)
    count, camera = 200_000, trial.queries[0].camera.scaled(602, 448)
    rotations = np.broadcast_to(np.eye(3), (count, 3, 3))
    scores = method_map.fit(camera, rotations, np.zeros((count, 3)), lambda words: np.zeros(len(words)))
    assert len(scores) == count
    assert 0 < largest * 448 * 80 <= 1 << 26


def test_what_a_method_counts_itself_is_counted_here(trial):
    trial.city_map.usage.take()
    RemoteMap(Here(trial.city_map), FAR).usage.add("wires", 7)
    assert trial.city_map.usage.take() == {"wires": 7}
    with pytest.raises(LodbenchError):
        answered(["count", "wires", -7], None, trial.city_map, None)


def test_only_what_is_offered_is_drawn_and_never_too_much(trial):
    camera, many = Camera(8000, 8000, 9e3, 9e3, 4e3, 4e3), (np.zeros((10**6, 3, 3)), np.zeros((10**6, 3)))
    for words, reason in (
        (["draw", "depth", {}, camera, *many], "too many at a time"),
        (["draw", "depth", {}, 7, *many], "with a camera and poses"),
        (["draw", "usage", {}], "no 'draw'"),
        (["true_pixels", many[1]], "no 'true_pixels'"),
        ([], "no ''"),
    ):
        with pytest.raises(LodbenchError, match=reason):
            answered(words, trial.queries[0], trial.city_map, streams_of(trial.queries[0]))
