"""What all segmenters share that look at photos, and networks that come with the package.

Of photos: reading, working size, cache, fingerprint, notes. The package's networks are run by OpenCV from
ONNX files and trained by ``lodbench train``.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from dataclasses import asdict
from functools import cache, cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench import kernels
from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, QueryFault
from lodbench.geometry import Camera
from lodbench.segmentation.masks import photo_of, read_photo
from lodbench.segmentation.onnx_file import read_onnx
from lodbench.segmentation.probability import (
    MemoryTiles,
    is_out_of_memory,
    padded_photo,
    probability_of,
    resized_photo,
    without_unsure_parts,
    working_size,
)
from lodbench.segmentation.protocol import FOR_PHOTOS, Segmenter, check_mask
from lodbench.segmentation.weight_files import weights_file
from lodbench.storage import digest_of, file_digest, make_folder, write_bytes
from lodbench.storage.digest import content_digest, digest_of_code, read_content
from lodbench.storage.paths import cache_root

_LOGGER = logging.getLogger(__name__)
Probability = NDArray[np.float32]
_FOLDER = "segmentations"
# What runs networks, and brings photos to their size; those of extras need not be there.
_LIBRARIES = ("numpy", "opencv-python-headless", "torch", "transformers")


def cached_probability(photo: Path, identity: str, compute: Callable[[bytes], Probability]) -> Probability:
    """Returns the probability of a photo: from the cache, or computed and put there.

    What is computed passes through the cache's 16 bits as well, so that a second run gives the same
    bytes as the first; a cache that cannot be written is no fault.

    Args:
        photo: The photo's file; its content counts, not its name.
        identity: Digest of all else it follows from, but our code: network, weights, size, normalisation.
        compute: Returns (H, W) float32 in [0, 1] of the content of the photo's file.

    Raises:
        OSError: The photo cannot be read.
        InputChanged: It is not what it was when the work began.
    """
    photo_content = read_content(photo)
    name = digest_of([hashlib.sha256(photo_content).hexdigest(), identity, _code_digest()], length=32)
    path = cache_root() / _FOLDER / f"{name}.npz"
    stored = _read(path)
    if stored is None:
        stored = np.rint(compute(photo_content) * 65535.0).astype(np.uint16)
        content = io.BytesIO()
        np.savez_compressed(content, probability=stored)
        try:
            make_folder(path.parent)
            write_bytes(path, content.getvalue())
        except OSError:
            pass  # a read-only cache or a full disk costs time, not the answer
    return stored.astype(np.float32) / np.float32(65535)


def _read(path: Path) -> NDArray[np.uint16] | None:
    """Returns what is stored, or None where there is nothing that can be read."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            stored = archive["probability"]
    except FileNotFoundError:
        return None
    except Exception as error:  # numpy, zipfile and zlib raise anything over a damaged file
        _LOGGER.warning("The mask kept in %s is damaged (%s): it is made anew.", path, error)
        return None
    return np.asarray(stored) if stored.dtype == np.uint16 and stored.ndim == 2 else None


@cache
def _code_digest() -> str:
    """Returns a digest of the code that makes masks: other code makes its own."""
    files = [*sorted(Path(__file__).parent.rglob("*.py")), Path(kernels.__file__).with_name("estimation.py")]
    return digest_of_code(files, _LIBRARIES)


# A change of how photos are read or brought to size makes another answer.
_VERSION = 1


class PhotoSegmenter(ABC):
    """Segments a query's photo with a network.

    Args:
        params: Settings of the segmenter, a frozen dataclass with ``name`` and ``normalise``.
    """

    requires = frozenset({Input.IMAGE})
    provides = frozenset({Input.MASK})
    # The file of the network's weights.
    _path: Path

    def __init__(self, params: Any) -> None:
        self.params = params
        self.name: str = params.name

    @cached_property
    def weights_digest(self) -> str:
        """Returns the SHA-256 of the weights' file.

        Raises:
            ConfigError: It is gone.
        """
        if not self._path.is_file():
            raise ConfigError(f"There are no weights {self._path}.", "Set `segmenter.weights=FILE`.")
        return file_digest(self._path)

    @abstractmethod
    def logits(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns (h, w) logits of a (H, W, 3) uint8 RGB photo, at the working size.

        Raises:
            QueryFault: This photo cannot be segmented.
        """

    def notes(self) -> tuple[str, ...]:
        """Returns what a reader of the results must know about the network."""
        return ()

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Returns the (h, w) float32 probability of building, in [0, 1], at the working size.

        Raises:
            QueryFault: The query has no photo, or it cannot be read.
        """
        return self.cached(entry, self.probability)

    def cached(
        self,
        entry: Entry,
        compute: Callable[[NDArray[np.uint8]], NDArray[np.float32]],
        idle: Collection[str] = (),
    ) -> NDArray[np.float32]:
        """Returns what is computed of a query's (H, W, 3) RGB photo, or was in an earlier run.

        Args:
            entry: The query.
            compute: Returns (h, w) float32 in [0, 1] of the photo.
            idle: Settings that make no difference to it.

        Raises:
            QueryFault: The query has no photo, or it cannot be read.
        """
        if entry.image is None:
            raise QueryFault("no photo to segment")
        name = entry.image.name
        try:
            return cached_probability(
                entry.image, self._identity(idle), lambda content: compute(photo_of(content, name))
            )
        except OSError as error:
            raise QueryFault(f"photo {name} cannot be read: {error.strerror}") from error

    def probability(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns the (h, w) float32 probability of building of a (H, W, 3) RGB photo."""
        return probability_of(self.logits(photo), self.params.normalise)

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns a digest of the photos' contents, the settings and the weights."""
        return digest_of([self._identity(), [[entry.key, content_digest(entry.image)] for entry in entries]])

    def _identity(self, idle: Collection[str] = ()) -> str:
        settings = {k: v for k, v in asdict(self.params).items() if k not in ("weights", *idle)}
        return digest_of([_VERSION, settings, self.weights_digest], length=32)


def require_photo_segmenter(segmenter: Segmenter) -> Segmenter:
    """Returns a segmenter that looks at a photo and at nothing else, a plug-in's perhaps.

    Raises:
        ConfigError: It looks at something else.
    """
    if declared_inputs(segmenter, "requires") != {Input.IMAGE}:
        hint = f"`--segmenter {FOR_PHOTOS}` does, and any other that requires the image alone."
        raise ConfigError(f"segmenter {segmenter.name} looks at no photo alone.", hint)
    return segmenter


def photo_probability(segmenter: Segmenter, photo: Path) -> NDArray[np.float32]:
    """Returns the (h, w) probability of building that a segmenter finds in a photo; not from our cache.

    Raises:
        QueryFault: The photo cannot be read, or the answer is no such array of its aspect.
    """
    pixels = read_photo(photo)
    if isinstance(segmenter, PhotoSegmenter):
        return segmenter.probability(pixels)
    height, width = pixels.shape[:2]
    camera = Camera(width, height, width, width, width / 2, height / 2)  # of which the size alone is used
    return check_mask(segmenter.segment(Entry(photo.name, "", camera, None, photo, None)), camera)


# What a file calls the answer of a network, by what that has learnt: networks may be alike in all else.
_ANSWERS = {"masks": "logits", "interiors": "interiors", "classes": "classes"}

# Logits of networks that have learnt something stay below a few hundred.
_MOST_LOGIT = 1e6


class PackagedNetwork(PhotoSegmenter):
    """Segments photos with a network whose weights come with the package, or from a training of one's own.

    Args:
        params: Its settings: ``name``, ``size``, ``normalise``, ``sure`` and ``weights``.

    Raises:
        ConfigError: The weights are missing or no network of this kind.
    """

    # Name of the package's weights, without ending; and what they were trained on, in a word.
    weights_name: str
    domain: str
    # ``sure`` of the package's weights, where no setting says otherwise.
    packaged_sure = 0.0
    # How photos are padded: rows that repeat may look like a wall.
    padding: Literal["edge", "symmetric"] = "edge"
    # Whether weights are stored in 16 bits: a large network shall not make the package large.
    stores_half = False
    # Sides of what the network sees are multiples of this.
    stride = 32
    learns = "masks"
    # Logits per pixel.
    channels = 1

    def __init__(self, params: Any) -> None:
        super().__init__(params)
        self._memory = MemoryTiles(params.name, params.size, self.stride)
        hint = "`segmenter.weights=FILE` takes an ONNX file; without it those of the package are taken."
        given = params.weights
        self._path = weights_file(given, hint, ".onnx") if given else self.packaged_weights()

    @cached_property
    def _net(self) -> Any:
        """Returns OpenCV's network; read on first use."""
        hint = f"lodbench train segmenter={self.name} writes one."
        net = read_onnx(self._path, hint, is_ours=self.params.weights is None, digest=self.weights_digest)
        outputs = net.getUnconnectedOutLayersNames()
        if len(outputs) != 1:
            raise ConfigError(f"{self._path} has {len(outputs)} outputs instead of one.", hint)
        learnt = next((what for what, answer in _ANSWERS.items() if answer == outputs[0]), self.learns)
        # The package's files were written before answers had names.
        if learnt != self.learns and self._path.resolve() != self.packaged_weights().resolve():
            raise ConfigError(f"{self._path} has learnt {learnt} of buildings, not {self.learns}.", hint)
        return net

    @abstractmethod
    def new_net(self, is_filled: bool) -> Any:
        """Returns the torch network as a training starts with it.

        Args:
            is_filled: Whether all its weights are about to be replaced.
        """

    def probability(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns the (h, w) float32 probability of building of a (H, W, 3) RGB photo."""
        sure = self.params.sure
        if sure is None:
            sure = 0.0 if self.params.weights else self.packaged_sure
        return without_unsure_parts(super().probability(photo), sure)

    def logits(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns (h, w), or (h, w, channels), logits of a (H, W, 3) RGB photo, its long side ``size``.

        Raises:
            ConfigError: The weights are no network of this kind.
            QueryFault: The photo does not fit into memory, not even in tiles.
        """
        return self.logits_at(photo, self.params.size)

    def logits_at(self, photo: NDArray[np.uint8], size: int) -> NDArray[np.float32]:
        """Returns (h, w) logits of a (H, W, 3) RGB photo whose long side is brought to some other size.

        Raises:
            LodbenchError: As for ``logits``.
        """
        height, width = photo.shape[:2]
        width, height = working_size(width, height, size)
        image = padded_photo(resized_photo(photo, width, height), self.stride, self.padding)
        return self._memory.run(image, self._run)[:height, :width]

    def _run(self, tile: NDArray[np.uint8]) -> NDArray[np.float32]:
        blob = np.ascontiguousarray(tile.transpose(2, 0, 1)[None], np.float32) / np.float32(255)
        hint = f"lodbench train segmenter={self.name} writes networks that answer {self.channels} per pixel."
        try:
            self._net.setInput(blob)
            logits = np.asarray(self._net.forward(), np.float32)
        except cv2.error as error:
            if is_out_of_memory(error):
                raise
            raise ConfigError(f"{self._path} is no network of photos: OpenCV cannot ask it.", hint) from error
        if logits.shape != (1, self.channels, *tile.shape[:2]):
            raise ConfigError(
                f"{self._path} answers {logits.shape} to a photo of {tile.shape[:2]}.",
                hint,
            )
        if self.params.weights:
            _require_logits(logits, self._path, hint)
        return np.asarray(logits[0, 0] if self.channels == 1 else logits[0].transpose(1, 2, 0))

    def build(self, init: str | None) -> Any:
        """Returns the torch network, with random weights, those of a checkpoint or those of an ONNX file.

        Raises:
            ConfigError: The file holds no weights of this network.
        """
        from lodbench.segmentation.nets.weights import load_weights

        return load_weights(self.new_net(init is not None), init, stride=self.stride)

    def packaged_weights(self) -> Path:
        """Returns the weights in the package."""
        return packaged_file(f"{self.weights_name}.onnx")

    def packaged_training(self) -> dict[str, Any]:
        """Returns what the package's weights were trained on and how."""
        path = packaged_file(f"{self.weights_name}.json")
        training: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        return training

    def store(self, net: Any, folder: Path) -> Path:
        """Writes a network as ONNX, its normalisations folded into the convolutions; returns the file."""
        from lodbench.segmentation.nets.weights import write_onnx

        path = folder / f"{self.weights_name}.onnx"
        write_onnx(net, path, self.stride, self.stores_half, _ANSWERS[self.learns])
        return path


def _require_logits(logits: NDArray[np.float32], path: Path, hint: str) -> None:
    """Makes sure that a network answers logits: of anything else the whole photo would be building."""
    # OpenCV makes the largest of all numbers of NaN.
    if not np.abs(logits).max() < _MOST_LOGIT:
        raise ConfigError(f"{path} answers NaN, or values beyond {_MOST_LOGIT:g}: it is damaged.", hint)
    if 0 <= logits.min() and (logits.max() <= 1 or logits.min() == 0):
        within = f"{abs(logits.min()):g} to {abs(logits.max()):g}"  # no negative zeros
        raise ConfigError(
            f"{path} answers values of {within}, as probabilities and classes are, where logits are wanted.",
            "Export it without the sigmoid, or whatever else is at its end.",
        )


def packaged_file(name: str) -> Path:
    """Returns a file of the package's weights."""
    return Path(str(files("lodbench.segmentation") / "weights" / name))
