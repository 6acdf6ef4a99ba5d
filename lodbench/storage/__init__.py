"""Files written safely, random streams, digests, and where data and caches live."""

from lodbench.storage.atomic import (
    new_folder,
    remove_leftovers,
    scratch_folder,
    write_bytes,
    write_chunks,
    write_text,
)
from lodbench.storage.digest import digest_of, file_digest
from lodbench.storage.disk import can_write, make_folder
from lodbench.storage.formulas import hide_formula, show_formula
from lodbench.storage.streams import random_stream

__all__ = [
    "can_write",
    "digest_of",
    "file_digest",
    "hide_formula",
    "make_folder",
    "new_folder",
    "random_stream",
    "remove_leftovers",
    "scratch_folder",
    "show_formula",
    "write_bytes",
    "write_chunks",
    "write_text",
]
