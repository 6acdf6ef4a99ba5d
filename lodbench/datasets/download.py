"""Fetching files with a stable address: resumed, capped, checked against their SHA-256, never half there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from lodbench.datasets.published.spec import Download
from lodbench.errors import DatasetError
from lodbench.storage.disk import disk, make_folder

_CHUNK_BYTES = 1 << 16
_TIMEOUT_S = 30
_PARTIAL, _OK = 206, 200


def fetch(
    download: Download, root: Path, progress: Callable[[int, int], None] | None = None
) -> tuple[Path, bool]:
    """Returns where a file is, and whether it was fetched; one that is there and right is left alone.

    An interrupted download goes on where it stopped: its beginning waits beside it, as ``.part``.

    Raises:
        DatasetError: The server cannot be reached, sends more than the file has, or something else; or
            another file stands in its place. Nothing is left under the file's name then.
    """
    try:
        import pooch
    except ImportError as error:
        raise DatasetError(
            "Downloading needs pooch.", "pip install 'lodbench[download]', or put the file there by hand."
        ) from error
    target = root / download.path
    if target.exists():
        if pooch.file_hash(str(target), alg="sha256") == download.sha256:
            return target, False
        raise DatasetError(
            f"{target} is another file than the published one.", "Move it away to fetch that one."
        )
    make_folder(target.parent)
    # pooch keeps the file's name free until the checksum is right.
    pooch.get_logger().setLevel("WARNING")
    try:
        pooch.retrieve(
            download.url,
            known_hash=f"sha256:{download.sha256}",
            fname=target.name,
            path=target.parent,
            downloader=_Resumed(target, download.num_bytes, progress),
        )
    except ValueError as error:  # pooch's word for a wrong checksum
        disk().remove(_partial_of(target))
        raise DatasetError(
            f"{download.url} is not the published file: its SHA-256 differs.",
            "Try again; if it stays so, the publisher changed the file.",
        ) from error
    disk().remove(_partial_of(target))
    return target, True


def _partial_of(target: Path) -> Path:
    return target.with_name(f".{target.name}.part")


class _Resumed:
    """A downloader for pooch that goes on where an earlier attempt stopped, and stops at a size.

    Args:
        target: Where the file will be; what is there of it lies beside.
        num_bytes: Size of the file: no byte more is taken.
        progress: Called with the bytes that are there and their total.
    """

    def __init__(self, target: Path, num_bytes: int, progress: Callable[[int, int], None] | None) -> None:
        self._target, self._num_bytes, self._progress = target, num_bytes, progress

    def __call__(self, url: str, output_file: str, pooch: Any) -> None:
        """Writes the file of an address to ``output_file``."""
        import requests

        partial = _partial_of(self._target)
        try:
            self._append(url, partial)
        except requests.RequestException as error:
            raise DatasetError(
                f"{url} cannot be fetched: {_reason(error)}.", "The same command goes on where it stopped."
            ) from error
        disk().rename(partial, Path(output_file))

    def _append(self, url: str, partial: Path) -> None:
        import requests

        have = partial.stat().st_size if partial.exists() else 0
        if have >= self._num_bytes:
            return
        headers = {"Range": f"bytes={have}-", "Accept-Encoding": "identity"} if have else {}
        with requests.get(url, headers=headers, stream=True, timeout=_TIMEOUT_S) as response:
            response.raise_for_status()
            if response.status_code != _PARTIAL:
                have = 0  # the server sends all of it again
            with partial.open("ab" if have else "wb", buffering=0) as stream:
                for chunk in response.iter_content(_CHUNK_BYTES):
                    have += len(chunk)
                    if have > self._num_bytes:
                        break
                    disk().write(stream, chunk, partial)
                    if self._progress is not None:
                        self._progress(have, self._num_bytes)
        if have > self._num_bytes:
            disk().remove(partial)
            raise DatasetError(
                f"{url} sends more than the {self._num_bytes:,} bytes that the file has.", "Nothing was kept."
            )
        if have < self._num_bytes:
            raise requests.ConnectionError(f"it ended after {have:,} of {self._num_bytes:,} bytes")


def _reason(error: Exception) -> str:
    """Returns what went wrong, without the address that the message names already."""
    response = getattr(error, "response", None)
    if response is not None:
        return f"the server answers {response.status_code} {response.reason}"
    text = str(error)
    return text if text.startswith("it ended") else type(error).__name__
