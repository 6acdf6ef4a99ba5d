"""What became of a flight, beside the poses of its photos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodbench.reporting.flight_words import PriorSource, constants_in_words, map_in_words


@dataclass(frozen=True, slots=True, eq=False)
class FlightAnswer:
    """What became of a flight; ``source`` is what its rough poses are from."""

    name: str
    photos: tuple[Path, ...]
    taken: tuple[str, ...]
    findings: dict[str, Any]
    source: PriorSource = "metadata"

    def sentences(self) -> list[str]:
        """Returns what the flight says of drone, camera and map."""
        lines = constants_in_words(self.findings.get("constants", {}), self.source)
        lines += map_in_words(self.findings)
        lines += self.findings.get("notes", [])
        reasons = self.findings.get("reasons", {})
        for name in self.findings.get("lost", []):
            reason = f": {reasons[name]}" if name in reasons else ""
            lines.append(f"pose from the other photos alone: {name}{reason}")
        return lines

    def to_json(self) -> dict[str, Any]:
        """Returns plain values for JSON."""
        return {
            "flight": self.name,
            "photos": [str(photo) for photo in self.photos],
            "taken": list(self.taken),
            "in_words": self.sentences(),
            **self.findings,
        }
