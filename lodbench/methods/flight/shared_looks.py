"""What roofs, walls and ground look like on the day of a flight, from all of its photos; masks from that.

One photo alone may show a corner of one roof. The flight has shown that roof, and its walls, from all around:
histograms of all photos but itself tell a photo what its buildings look like. Exposures differ from photo to
photo, and are found first: what a surface of a kind looks like is the same but for a gain of each photo.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.estimation.state_vector import differences
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.flight.params import FlightParams
from lodbench.methods.protocol import Estimate
from lodbench.photos.pictures import read_picture
from lodbench.rendering.masks import signed_distance
from lodbench.segmentation.map_guided import cross_fitted, cut
from lodbench.segmentation.probability import working_size

Floats = NDArray[np.float64]
Bins = NDArray[np.int64]

# Photos are looked at with this long side, pixels.
_SIZE = 300
# Kinds of surface; a roof is what looks up by more than this, the upward part of its normal.
_GROUND, _ROOF, _WALL = range(3)
_LOOKS_UP = 0.5
# Levels of brightness, of two differences of colours, and of texture.
_LEVELS = (8, 6, 6, 3)
# What is added to 8-bit colours before logarithms: black is noise.
_BLACK = 8.0
# A kind is seen by so many pixels further than this from outlines, or a photo says nothing of it.
_FEWEST_PX, _SURE_PX = 60, 3.0
# How far places are believed that a photo does not say itself.
_LEAST_TRUST = 0.1
# Rounds in which gains and looks are separated.
_ROUNDS = 12


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """A photo at the working size, and which kind of surface each pixel shows from where it was taken."""

    picture: NDArray[np.uint8]  # (H, W, 3) uint8 BGR
    kinds: NDArray[np.int64]  # (H, W) of the constants above
    weights: Floats  # (H, W) how far pixels count: less near outlines


def with_masks_by_looks(
    queries: Sequence[Query], vectors: Floats, trusts: Floats, city_map: CityMap
) -> list[Query]:
    """Returns a flight's queries with masks made of their photos, by what all photos show.

    A photo that cannot be read has an empty mask. Photos were taken at about (P, 6), metres and degrees,
    believed as far as (P,), 0 to 1.
    """
    looks = [look_of(query, vector, city_map) for query, vector in zip(queries, vectors, strict=True)]
    indices = [k for k, look in enumerate(looks) if look is not None]
    shown = [look for look in looks if look is not None]
    nats = dict(zip(indices, _nats(shown, trusts[indices]), strict=True)) if shown else {}
    masked = []
    for k, (query, look) in enumerate(zip(queries, looks, strict=True)):
        if look is None:
            size = query.camera.height, query.camera.width
            masked.append(replace(query, building_probability=np.zeros(size, np.float32)))
            continue
        silhouette = look.kinds != _GROUND
        own = cross_fitted(look.picture, silhouette) if silhouette.any() else np.zeros(silhouette.shape)
        mask = cut(look.picture, silhouette, 0.5 * (nats[k] + own)) if silhouette.any() else nats[k] > 0
        masked.append(replace(query, building_probability=np.asarray(mask, np.float32)))
    return masked


def agreed_places(
    priors: Floats, alone: Sequence[Estimate | QueryFault], params: FlightParams
) -> tuple[Floats, Floats]:
    """Returns (P, 6) about where photos were taken, and (P,) how far each place is believed.

    Photos whose answers, at least one, lie where most say that sensors err are believed; the others are put
    there. Priors, (P, 6), are what sensors and ties say.
    """
    known = np.array([k for k, each in enumerate(alone) if isinstance(each, Estimate)])
    estimates = [each for each in alone if isinstance(each, Estimate)]
    poses = np.array([vector_from_pose(each.pose) for each in estimates])
    chances = np.array([max(each.probability or 0.0, _LEAST_TRUST) for each in estimates])
    offsets = differences(poses, priors[known])
    width = 3.0 * params.own_sigmas() + 0.25 * params.shared_sigmas()
    agree = np.asarray((np.abs(offsets[:, None] - offsets[None]) < width).all(axis=2))
    chosen = agree[int(np.argmax(agree @ chances))]
    vectors, trusts = priors + np.median(offsets[chosen], axis=0), np.full(len(priors), _LEAST_TRUST)
    vectors[known[chosen]], trusts[known[chosen]] = poses[chosen], chances[chosen]
    return vectors, trusts


def look_of(query: Query, vector: Floats, city_map: CityMap) -> Look | None:
    """Returns a photo as it is looked at from a pose, (6,); None for one that cannot be read."""
    photo = None if query.image is None else read_picture(query.image)
    if photo is None:
        return None
    colours = photo if photo.ndim == 3 else np.repeat(photo[..., None], 3, axis=2)
    camera = query.camera.scaled(*working_size(query.camera.width, query.camera.height, _SIZE))
    picture = cv2.resize(colours, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    pose = pose_from_vector(vector)
    (normals,) = city_map.normals(camera, pose.rotation[None], pose.center[None])
    is_there = (normals != 0).any(axis=-1)
    kinds = np.where(is_there, np.where(normals[..., 2] > _LOOKS_UP, _ROOF, _WALL), _GROUND)
    weights = np.clip(np.abs(signed_distance(is_there)) / _SURE_PX, 0.1, 1.0)
    return Look(np.asarray(picture, np.uint8), kinds.astype(np.int64), weights.astype(np.float64))


def _nats(looks: Sequence[Look], trusts: Floats) -> list[Floats]:
    """Returns (H, W) nats by which pixels look like buildings and not like ground, by the other photos."""
    bins = _binned(looks, exposures(looks))
    count = int(np.prod(_LEVELS))
    each = np.zeros((len(looks), 3, count))
    for k, (look, of_photo) in enumerate(zip(looks, bins, strict=True)):
        for kind in (_GROUND, _ROOF, _WALL):
            mine = look.kinds == kind
            each[k, kind] = trusts[k] * np.bincount(of_photo[mine], look.weights[mine], count)
    pooled, log_odds = each.sum(axis=0), []
    for k, of_photo in enumerate(bins):
        # Of a photo by itself there are no others.
        others = pooled - each[k] if len(looks) > 1 else pooled
        chances = (others + 0.5) / (others + 0.5).sum(axis=1, keepdims=True)
        shares = others[1:].sum(axis=1) + 1.0
        built = shares @ chances[1:] / shares.sum()
        nats = np.log(built) - np.log(chances[_GROUND])
        log_odds.append(cv2.GaussianBlur(nats[of_photo], (0, 0), 1.0))
    return log_odds


def exposures(looks: Sequence[Look]) -> Floats:
    """Returns (P, 3) logarithms of how much brighter each photo shows blue, green and red than the flight.

    Where two photos show a kind of surface, the difference of its medians is that of their gains; a photo
    that shows one kind only has its gain from that one (median polish of photos by kinds).
    """
    medians = np.full((len(looks), 3, 3), np.nan)
    for k, look in enumerate(looks):
        logs = np.log(look.picture.astype(np.float64) + _BLACK)
        for kind in (_GROUND, _ROOF, _WALL):
            sure = (look.kinds == kind) & (look.weights >= 1.0)
            if np.count_nonzero(sure) >= _FEWEST_PX:
                medians[k, kind] = np.median(logs[sure], axis=0)
    gains, typical = np.zeros((len(looks), 3)), np.zeros((3, 3))
    with warnings.catch_warnings():
        # Of what no photo shows, or of a photo that shows nothing, there is no median.
        warnings.simplefilter("ignore", RuntimeWarning)
        for _ in range(_ROUNDS):
            typical = np.nan_to_num(np.nanmedian(medians - gains[:, None], axis=0))
            gains = np.nan_to_num(np.nanmedian(medians - typical, axis=1))
            gains -= np.median(gains, axis=0)
    return gains


def _binned(looks: Sequence[Look], gains: Floats) -> list[Bins]:
    """Returns (H, W) bins of brightness, colour and texture, their levels the same in all photos."""
    channels = [_channels(look.picture, gain) for look, gain in zip(looks, gains, strict=True)]
    bins = [np.zeros(look.kinds.shape, np.int64) for look in looks]
    for number, count in enumerate(_LEVELS):
        values = [each[number] for each in channels]
        # Every fifth pixel is enough for the levels.
        some = np.concatenate([value.ravel()[::5] for value in values])
        edges = np.quantile(some, np.arange(1, count) / count)
        bins = [b * count + np.searchsorted(edges, v) for b, v in zip(bins, values, strict=True)]
    return bins


def _channels(picture: NDArray[np.uint8], gain: Floats) -> list[Floats]:
    logs = cv2.GaussianBlur(np.log(picture.astype(np.float64) + _BLACK) - gain, (0, 0), 0.7)
    blue, green, red = (logs[..., k] for k in range(3))
    bright = (blue + green + red) / 3.0
    texture = cv2.GaussianBlur(np.abs(cv2.Laplacian(bright, cv2.CV_64F)), (0, 0), 2.0)
    return [np.asarray(channel, np.float64) for channel in (bright, red - green, blue - green, texture)]
