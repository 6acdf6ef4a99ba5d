"""Frames of a video or a folder, one after the other, with their masks made ahead of their use."""

from __future__ import annotations

import itertools
import math
import os
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.own import find_mask
from lodbench.errors import DatasetError, LodbenchError, QueryFault
from lodbench.geometry import Camera
from lodbench.photos.camera import undistorted
from lodbench.photos.files import PHOTO_SUFFIXES, find_photos, in_pose_lines, natural_key, require_photos
from lodbench.photos.metadata import read_photo_metadata
from lodbench.photos.pictures import opencv_silenced, read_picture
from lodbench.segmentation import Segmenter, check_mask
from lodbench.segmentation.masks import read_mask
from lodbench.storage.paths import require_regular

# What photos without clocks are taken to be, a second.
PHOTO_RATE = 1.0
_NO_CLOCK = f"no clock to order the photos by: {PHOTO_RATE:g} a second is assumed; --fps says how many"
_WHOLE_SECONDS = (
    "the photos' clock counts whole seconds: those of one second are taken as evenly spaced; "
    "--fps says how many there are"
)
Mask = NDArray[np.float32]
# What FFmpeg may take a video for, whatever its content says: playlists and scripts open other files.
_CONTAINERS = (
    "mov,matroska,avi,mpegts,mpeg,mpegvideo,flv,asf,ogg,mxf,h264,hevc,m4v,mjpeg,ivf,yuv4mpegpipe,gif"
)
# What a video is taken to be where it does not say, frames per second.
_VIDEO_RATE = 25.0
# A video with less than this share of the frames that it says to have is not whole: some only estimate them.
_LEAST_READ = 0.95
# Frames whose masks are made while another is aligned.
_AHEAD = 2


def photo_clocks(photos: Sequence[Path]) -> tuple[list[float] | None, list[str]]:
    """Returns when photos were taken, seconds after the first, and what the reader should know of it.

    Several of one second are taken to be evenly spaced in it, and photos that do not say, to be so between
    their neighbours. Where fewer than two say, or clocks stand still or run back, there are no times.
    """
    if len(photos) < 2:
        return None, []
    stated = _stated(photos)
    rows = [row for row, second in enumerate(stated) if second is not None]
    reported = [second for second in stated if second is not None]
    notes = []
    if not _rises(reported):
        whole = [float(second // 1) for second in reported]
        if whole[0] == whole[-1] or whole != sorted(whole):
            return None, [_NO_CLOCK]
        reported, notes = _spread(whole), [_WHOLE_SECONDS]
    if len(reported) < 2:
        return None, [_NO_CLOCK]
    if len(reported) < len(photos):
        reported = _filled(rows, reported, len(photos))
        notes.append(
            f"photos without a clock, {len(photos) - len(rows)}, are placed between their neighbours"
        )
    return _from_first(reported), notes


def _stated(photos: Sequence[Path]) -> list[float | None]:
    """Returns seconds after a whole one; None where a clock lacks."""
    times: list[datetime | None] = []
    for photo in photos:
        try:
            stated = read_photo_metadata(photo)
            taken = datetime.strptime(stated.taken_at, "%Y:%m:%d %H:%M:%S")
            times.append(taken + timedelta(seconds=stated.taken_fraction_s or 0.0))
        except (ValueError, LodbenchError):
            times.append(None)
    first = next((time for time in times if time is not None), datetime.min).replace(microsecond=0)
    return [None if taken is None else (taken - first).total_seconds() for taken in times]


def _filled(rows: Sequence[int], reported: Sequence[float], count: int) -> list[float]:
    """Returns the times of all photos from those of some rows: evenly between, as fast before and after."""
    pace = (reported[-1] - reported[0]) / (rows[-1] - rows[0])
    known_rows = [-1, *rows, count]
    known = [reported[0] - pace * (rows[0] + 1), *reported, reported[-1] + pace * (count - rows[-1])]
    return [float(second) for second in np.interp(range(count), known_rows, known)]


def _from_first(seconds: Sequence[float]) -> list[float]:
    return [second - seconds[0] for second in seconds]


def _rises(seconds: Sequence[float]) -> bool:
    return all(later > sooner for sooner, later in pairwise(seconds))


def _spread(whole: Sequence[float]) -> list[float]:
    """Returns whole seconds with what is of one second evenly spaced in it.

    The first second and the last were begun or left in between, so they hold as many as the fullest would.
    """
    counts, done = Counter(whole), Counter[float]()
    fullest, spread = max(counts.values()), []
    for second in whole:
        is_cut = second in (whole[0], whole[-1])
        before = fullest - counts[second] if second == whole[0] else 0
        spread.append(second + (before + done[second]) / (fullest if is_cut else counts[second]))
        done[second] += 1
    return spread


class Shot(NamedTuple):
    """A frame as it was taken."""

    name: str  # of the frame
    time_s: float  # when it was taken, seconds
    # (H, W, 3) BGR, of a photo as stored, of a video as shown; None where they cannot be decoded, or are of
    # a photo whose mask is there.
    pixels: NDArray[np.uint8] | None
    size: tuple[int, int] | None  # width and height, None where they are not known
    file: Path | None = None  # the photo, None of a video


@dataclass(frozen=True, slots=True)
class Footage:
    """What is tracked."""

    source: Path  # a video, or a folder of photos
    every: int = 1  # every how manieth frame is taken
    rate: float | None = None  # frames per second, before what the video or the photos' clocks say
    masks: Path | None = None  # folder of masks, whose pictures are no frames
    out: Path | None = None  # folder of results, likewise
    notes: list[str] = field(default_factory=list)  # what the reader should know, once all frames were taken

    def photos(self) -> list[Path]:
        """Returns the photos of a folder, in the order of their names: 2 before 10.

        Raises:
            DatasetError: There are none, or two have one name: masks and poses go by it.
        """
        source = self.source
        photos = find_photos(source, self.masks, self.out)
        require_photos(photos, source)
        count = Counter(in_pose_lines(photo.name) for photo in photos)
        name, most = count.most_common(1)[0]
        if most > 1:
            raise DatasetError(f"{source} holds {most} photos called {name}.", "Track one folder at a time.")
        return sorted(photos, key=lambda photo: [*map(natural_key, photo.relative_to(source).parts)])

    def shots(self) -> Iterator[Shot]:
        """Yields the frames.

        Raises:
            DatasetError: There are none.
        """
        return self._of_photos() if self.source.is_dir() else self._of_video()

    def names(self) -> Iterator[str]:
        """Yields what the frames are called; of a video without end, as it may state no length."""
        if self.source.is_dir():
            return (photo.name for photo in self.photos()[:: self.every])
        return map(_frame_name, itertools.count(step=self.every))

    def video_size(self) -> tuple[int, int] | None:
        """Returns width and height of a video's first frame as shown, None where that cannot be decoded.

        Raises:
            DatasetError: It is no video, or has no frames.
        """
        return next(self._of_video()).size

    def first_photo(self) -> Path | None:
        """Returns the first photo of a folder; None for a video."""
        return self.photos()[0] if self.source.is_dir() else None

    def _of_photos(self) -> Iterator[Shot]:
        photos = self.photos()[:: self.every]
        rate = self.rate or PHOTO_RATE
        clocks = [self.every * number / rate for number in range(len(photos))]
        if self.rate is None:
            reported, note = photo_clocks(photos)
            clocks = reported or clocks
            self.notes.extend(note)
        for photo, when in zip(photos, clocks, strict=True):
            # A mask that is there is looked at alone: decoding a drone's photo takes longer than aligning it.
            pixels = read_picture(photo) if self.masks is None else None
            size = _stated_size(photo) if pixels is None else _size(pixels)
            yield Shot(photo.name, when, pixels, size, photo)

    def _of_video(self) -> Iterator[Shot]:
        import cv2

        if self.source.suffix.lower() in PHOTO_SUFFIXES:
            raise DatasetError(f"{self.source} is one photo.", "lodbench localize finds where it was taken.")
        require_regular(self.source)
        with opencv_silenced():
            video = cv2.VideoCapture(str(self.source), _backend())
            if not video.isOpened():
                raise DatasetError(
                    f"{self.source} is no video that OpenCV reads.", "Take MP4, or a folder of photos."
                )
            yield from self._frames_of(video)

    def _frames_of(self, video: Any) -> Iterator[Shot]:
        import cv2

        # As players and FFmpeg show the frames, so that masks made of extracted ones fit, too.
        video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1.0)
        turn_deg = float(video.get(cv2.CAP_PROP_ORIENTATION_META))
        stated = float(video.get(cv2.CAP_PROP_FPS))
        # Some containers say 0, -1 or no number at all.
        rate = self.rate or (stated if 0 < stated < math.inf else _VIDEO_RATE)
        count, number, time_s = float(video.get(cv2.CAP_PROP_FRAME_COUNT)), 0, -1.0 / rate
        try:
            while video.grab():
                # Phones vary their rate: each frame says its time, unless the container has none.
                stamp_s = float(video.get(cv2.CAP_PROP_POS_MSEC)) / 1000.0
                is_stamped = self.rate is None and math.isfinite(stamp_s) and stamp_s > time_s
                time_s = stamp_s if is_stamped else (number / rate if self.rate else time_s + 1.0 / rate)
                if number % self.every == 0:
                    is_whole, frame = video.retrieve()
                    pixels = np.asarray(frame, dtype=np.uint8) if is_whole else None
                    size = None if pixels is None else _size(pixels)
                    yield Shot(_frame_name(number), time_s, pixels, size)
                number += 1
        finally:
            video.release()
        if number == 0:
            raise DatasetError(f"{self.source} holds no frames.", "Copy it again.")
        if turn_deg:
            self.notes.append(
                f"the video is stored turned, and shown turned by {turn_deg:.0f} degrees clockwise: camera "
                "and masks are of its frames as shown"
            )
        if number < _LEAST_READ * count:
            self.notes.append(
                f"{number} of the video's {count:.0f} frames can be read: it is cut off or damaged"
            )


def _backend() -> int:
    """Returns FFmpeg, silent and bound to containers, where OpenCV has it.

    Others take pictures for videos, and print.
    """
    import cv2

    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", f"format_whitelist;{_CONTAINERS}")
    return int(cv2.CAP_FFMPEG if cv2.CAP_FFMPEG in cv2.videoio_registry.getBackends() else cv2.CAP_ANY)


def _size(pixels: NDArray[np.uint8]) -> tuple[int, int]:
    return pixels.shape[1], pixels.shape[0]


def _stated_size(photo: Path) -> tuple[int, int] | None:
    try:
        stated = read_photo_metadata(photo)
    except LodbenchError:
        return None
    return stated.width, stated.height


def _frame_name(number: int) -> str:
    return f"frame_{number:06d}.png"


@dataclass(slots=True)
class MaskMaker:
    """Masks of frames, from a folder or by a network."""

    camera: Camera  # of the frames as stored, lens included
    pinhole: Camera  # what is tracked
    folder: Path | None  # of masks named as the frames; goes before the segmenter
    segmenter: Segmenter | None  # makes them
    seconds: float = 0.0  # spent so far

    def mask(self, shot: Shot) -> Mask | str:
        """Returns (H, W) the probability of building as the pinhole sees it, or why there is none."""
        started = time.perf_counter()
        try:
            mask = check_mask(self._made(shot), self.camera)
            return np.asarray(undistorted(mask, self.camera, self.pinhole))
        except QueryFault as fault:
            return fault.message
        finally:
            self.seconds += time.perf_counter() - started

    def _made(self, shot: Shot) -> Mask:
        if shot.size not in (None, (self.camera.width, self.camera.height)):
            raise QueryFault("it is {} x {}, not as the camera".format(*shot.size))
        if self.folder is not None:
            file = find_mask(self.folder, shot.name, shot.file)
            if file is None:
                raise QueryFault(f"{self.folder} holds no mask of it")
            return read_mask(file)
        if shot.pixels is None:
            raise QueryFault("its pixels cannot be decoded")
        network: Any = self.segmenter
        return np.asarray(network.probability(np.ascontiguousarray(shot.pixels[..., ::-1])))


def with_masks(shots: Iterator[Shot], maker: MaskMaker) -> Iterator[tuple[Shot, Mask | str]]:
    """Yields frames with their masks, or why there is none; the next ones are made while one is used."""

    def following() -> tuple[Shot, Mask | str] | None:
        shot = next(shots, None)
        return None if shot is None else (shot, maker.mask(shot))

    with ThreadPoolExecutor(1) as pool:
        waiting: deque[Future[tuple[Shot, Mask | str] | None]] = deque(
            pool.submit(following) for _ in range(_AHEAD)
        )
        while (made := waiting.popleft().result()) is not None:
            waiting.append(pool.submit(following))
            yield made
