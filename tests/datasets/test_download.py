"""Downloads from a server on this machine: whole, resumed, cut off, too long, wrong, missing."""

import hashlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from lodbench.datasets.published.catalogue import SPECS, fetch
from lodbench.datasets.published.layout import Download
from lodbench.errors import DatasetError

pytest.importorskip("pooch")
CONTENT = bytes(range(256)) * 2000


@dataclass
class Site:
    """What the server does, and what it was asked."""

    url: str = ""
    stop_after: int | None = None
    knows_ranges: bool = True
    ranges: list[str] = field(default_factory=list)


@pytest.fixture
def site() -> Iterator[Site]:
    state = Site()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            wanted = self.headers.get("Range", "")
            state.ranges.append(wanted)
            start = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted and state.knows_ranges else 0
            if self.path != "/city.obj":
                self.send_error(404)
                return
            self.send_response(206 if start else 200)
            self.send_header("Content-Length", str(len(CONTENT) - start))
            self.end_headers()
            end = len(CONTENT) if state.stop_after is None else start + state.stop_after
            self.wfile.write(CONTENT[start:end])

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    state.url = f"http://127.0.0.1:{server.server_port}/city.obj"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield state
    server.shutdown()
    server.server_close()


@pytest.fixture
def download(site: Site) -> Download:
    return Download(site.url, "MODEL/city.obj", hashlib.sha256(CONTENT).hexdigest(), len(CONTENT))


def files(root: Path) -> list[str]:
    return sorted(path.name for path in root.rglob("*") if path.is_file())


def test_a_file_is_fetched_once(site, download, tmp_path):
    path, is_new = fetch(download, tmp_path)
    assert path == tmp_path / "MODEL" / "city.obj"
    assert path.read_bytes() == CONTENT
    assert is_new
    assert files(tmp_path) == ["city.obj"]
    assert fetch(download, tmp_path) == (path, False)
    assert len(site.ranges) == 1


@pytest.mark.parametrize("knows_ranges", [True, False])
def test_an_interrupted_download_goes_on(site, download, tmp_path, knows_ranges):
    site.stop_after = 100_000
    with pytest.raises(DatasetError, match="cannot be fetched") as caught:
        fetch(download, tmp_path)
    assert "goes on where it stopped" in caught.value.hint
    assert files(tmp_path) == [".city.obj.part"]
    have = (tmp_path / "MODEL" / ".city.obj.part").stat().st_size
    assert 0 < have <= 100_000
    site.stop_after, site.knows_ranges = None, knows_ranges
    path, _ = fetch(download, tmp_path)
    assert path.read_bytes() == CONTENT
    assert site.ranges == ["", f"bytes={have}-"]
    assert files(tmp_path) == ["city.obj"]


def test_another_content_is_refused(download, tmp_path):
    with pytest.raises(DatasetError, match="not the published file"):
        fetch(replace(download, sha256="0" * 64), tmp_path)
    assert files(tmp_path) == []


def test_more_than_the_file_has_is_refused(download, tmp_path):
    with pytest.raises(DatasetError, match="more than the 1,000 bytes"):
        fetch(replace(download, num_bytes=1000), tmp_path)
    assert files(tmp_path) == []


def test_a_missing_page(site, download, tmp_path):
    with pytest.raises(DatasetError, match="the server answers 404"):
        fetch(replace(download, url=site.url + "x"), tmp_path)
    assert files(tmp_path) == []


def test_a_file_put_there_by_hand_is_left_alone(site, download, tmp_path):
    path = tmp_path / "MODEL" / "city.obj"
    path.parent.mkdir()
    path.write_bytes(CONTENT)
    assert fetch(download, tmp_path) == (path, False)
    path.write_bytes(b"mine")
    with pytest.raises(DatasetError, match="another file"):
        fetch(download, tmp_path)
    assert path.read_bytes() == b"mine"
    assert site.ranges == []


def test_the_published_checksum_is_that_of_the_sample_data(shared_data):
    (download,) = SPECS["uavd4l_lodv2"].downloads
    content = (shared_data / "uavd4l" / "UAVD4L-LoD1.obj").read_bytes()
    assert len(content) == download.num_bytes
    assert hashlib.sha256(content).hexdigest() == download.sha256
