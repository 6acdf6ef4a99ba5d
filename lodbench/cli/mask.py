"""`lodbench mask`: a photo's building mask, corrected with strokes on a page, or handed to other programs."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lodbench.cli.parser import Parser
from lodbench.errors import ConfigError, require_within

if TYPE_CHECKING:
    from lodbench.harness.mask import MaskSession

_FORMATS = ("labelme", "coco", "geojson")
_EXAMPLES = """\
The page is served to this machine alone. Strokes add to the mask or erase from it; similar
pixels nearby are included.

examples:
  lodbench mask DJI_0001.JPG                                   go on with DJI_0001_mask.png, or begin one
  lodbench mask DJI_0001.JPG --mask other.png --out new.png    start from another
  lodbench mask DJI_0001.JPG --no-page --export labelme        for LabelMe; then bring it back:
  lodbench mask DJI_0001.JPG --no-page --import DJI_0001_mask.labelme.json
  lodbench localize DJI_0001.JPG --city city.gml --mask DJI_0001_mask.png
"""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = _parser().parse_args(argv)
    from lodbench.cli.parts import require_one_mask_source, segmenter_of
    from lodbench.harness.mask import (
        Untouched,
        opened_session,
        require_untouched,
        require_unturned,
        saved,
    )
    from lodbench.photos.files import mask_name

    if options.photo.is_dir():
        raise ConfigError(f"{options.photo} is a folder.", "Name a photo: lodbench mask PHOTO")
    require_one_mask_source(options, "--mask", "--import")
    polygons: Path | None = vars(options)["import"]
    require_within("--port", options.port, 0, 65535)
    out = options.out or options.photo.with_name(mask_name(options.photo.stem))
    _check_out(out, options.photo)
    formats = tuple(dict.fromkeys(options.export))
    untouched = Untouched(out, formats)  # before anything of them is read
    mask = _start(options, polygons, out)
    if options.out is None:
        require_untouched(out, options.photo, formats, polygons)
    segmenter = None
    if mask is None and polygons is None:
        from lodbench.segmentation.photo_segmenter import require_photo_segmenter
        from lodbench.segmentation.registry import FOR_PHOTOS

        made = segmenter_of(options.segmenter or FOR_PHOTOS, options.segmenter_option)
        segmenter = require_photo_segmenter(made)
    require_unturned(options.photo, formats, polygons)
    session = opened_session(options.photo, mask, polygons, segmenter)
    if polygons is not None and options.out is None and out.exists() and not session.mask.any():
        raise ConfigError(f"{polygons.name} shows no building, and {out} would be replaced.", _keep_hint(out))

    def save() -> tuple[Path, ...]:
        once_more = "Keep a copy of it if it is needed; saving once more replaces it."
        untouched.require(once_more if options.page else _keep_hint(out))
        try:
            return saved(session.mask, options.photo, out, formats)
        finally:
            untouched.remember()  # of a save that failed half way too: what is there is its own

    if options.page:
        _serve(session, options, out, save)
    else:
        for path in save():
            sys.stdout.write(f"written: {path}\n")
    return 0


def _check_out(out: Path, photo: Path) -> None:
    """Makes sure that a mask can be saved under a name."""
    from lodbench.photos.files import mask_name

    if out.is_dir():
        inside = shlex.quote(str(out / mask_name(photo.stem)))
        raise ConfigError(f"--out {out} is a folder.", f"Name a file: --out {inside}")
    if out.suffix.lower() != ".png":
        png = shlex.quote(str(out.with_suffix(".png")))
        raise ConfigError(f"--out {out} is not a PNG file.", f"Masks are PNG: --out {png}")
    if out.exists() and photo.exists() and out.samefile(photo):
        raise ConfigError("--out is the photo itself.", "Leave it out, or name another file.")


def _start(options: argparse.Namespace, polygons: Path | None, out: Path) -> Path | None:
    """Returns the mask to start from: what was named, else the one that was saved before."""
    named: Path | None = options.mask
    # Polygons were written from that mask: what comes back is meant to replace it.
    if options.out is not None or polygons is not None or not out.exists():
        return named
    makes_new = options.segmenter is not None or bool(options.segmenter_option)
    if makes_new or (named is not None and named.exists() and not named.samefile(out)):
        raise ConfigError(f"{out} is there, and would be replaced.", _keep_hint(out))
    if named is None:
        sys.stdout.write(f"starts from: {out}, which is there\n")
    return out if named is None else named


def _keep_hint(out: Path) -> str:
    return f"Keep it, and save elsewhere: --out OTHER.png; replace it: --out {shlex.quote(str(out))}"


def _serve(
    session: MaskSession, options: argparse.Namespace, out: Path, save: Callable[[], tuple[Path, ...]]
) -> None:
    """Serves the page until it is closed, or Ctrl+C, which keeps unsaved strokes beside the mask."""
    from lodbench.harness.local_page import MaskServer
    from lodbench.harness.mask import saved
    from lodbench.harness.tracebacks import last_write

    def saved_words() -> str:
        return "saved: " + ", ".join(path.name for path in save())

    try:
        server = MaskServer(session, options.photo.name, saved_words, options.port)
    except OSError as error:
        raise ConfigError(
            f"--port {options.port} cannot be listened at: {error.strerror}.",
            "Leave it out, or name another.",
        ) from error
    with server:
        sys.stdout.write(
            f"open: {server.address}\nCtrl+C, or Close on the page, ends it; Save keeps the mask.\n"
        )
        sys.stdout.flush()
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            if session.is_changed:
                # No picture by its name: a folder of photos would have one more.
                aside = out.with_name(f"{out.name}.unsaved")
                with last_write(aside):
                    saved(session.mask, options.photo, aside, ())
                    again = shlex.join(["--mask", str(aside), "--out", str(out)])
                    words = f"\nnot saved: strokes since the last Save. Go on with them: {again}\n"
                    sys.stdout.write(words)
            raise


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        "lodbench mask", "Correct the mask of a photo's buildings, or hand it to another program.", _EXAMPLES
    )
    add = parser.add_argument
    add("photo", type=Path, metavar="PHOTO", help="as it is stored")
    start = parser.add_mutually_exclusive_group()
    start.add_argument("--mask", type=Path, metavar="FILE", help="start from this mask: white is building")
    start.add_argument("--import", type=Path, metavar="FILE", help="start from polygons of LabelMe or COCO")
    start.add_argument(
        "--segmenter", metavar="NAME", help="from its mask (efficient_unet, where none is saved)"
    )
    add("--segmenter-option", action="append", default=[], metavar="KEY=VALUE", help="may be repeated")
    add("--out", type=Path, metavar="FILE", help="where to save it (PHOTO_mask.png)")
    add("--export", action="append", default=[], choices=_FORMATS, help="polygons beside it; may be repeated")
    add("--no-page", dest="page", action="store_false", help="save at once, without a page")
    add("--port", type=int, default=0, help="of the page (any that is free)")
    return parser
