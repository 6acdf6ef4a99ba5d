"""What runs and their tables are called: what they have in common, and what sets each apart."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from lodbench.citymodel.lods import lod_in_words

# Parts of the protocol that may be freed to differ within a table.
FREE = ("lod", "segmenter", "renderer", "tilt", "prior", "seed")
# How names of a segmenter's settings begin.
_OF_SEGMENTER = "segmenter."


def title_of(summary: dict[str, Any], free: Collection[str] = ()) -> str:
    """Returns what a run's table is headed with: everything that must agree to compare rows."""
    dataset, protocol = summary["dataset"], summary["protocol"]
    version = f" ({dataset['version']})" if dataset.get("version") else ""
    lod = f" · {lod_in_words(str(protocol['lod']))}" if protocol.get("lod") and "lod" not in free else ""
    words = [f"{name}={protocol[name]}" for name in ("tilt", "segmenter", "seed") if name not in free]
    drawn = protocol.get("prior", "file")
    if drawn != "file" and "prior" not in free:
        words.append(f"priors {drawn}")
    return " · ".join([f"{dataset['name']}{version}{lod}", *words])


def titles_of(heads: Sequence[str], summaries: Sequence[dict[str, Any]]) -> list[str]:
    """Returns the titles of tables, given a run of each; those of one dataset say how its data were set."""
    titles = []
    for head, summary in zip(heads, summaries, strict=True):
        peers = [other for other in summaries if _dataset_of(other) == _dataset_of(summary)]
        # The level of detail is in the head, where it is known.
        words = [word for word in _set_apart(summary, peers) if not word.startswith("lod=")]
        titles.append(" · ".join([head, *words]))
    return titles


def _dataset_of(summary: dict[str, Any]) -> tuple[str, str]:
    return summary["dataset"]["name"], summary["dataset"]["version"]


def _set_apart(summary: dict[str, Any], peers: Sequence[dict[str, Any]]) -> list[str]:
    """Returns the settings of a run's data that are not those of its peers, where they are known.

    And those of its segmenter that peers of the same segmenter set otherwise.
    """
    alike = [peer for peer in peers if _segmenter(peer) == _segmenter(summary)]
    known = {key: value for key, value in summary.get("settings", {}).items() if value is not None}
    words = []
    for key, value in known.items():
        others = alike if key.startswith(_OF_SEGMENTER) else peers
        if any(other.get("settings", {}).get(key) != value for other in others):
            words.append(f"{key}={value}")
    return words


def _segmenter(summary: dict[str, Any]) -> str:
    return str(summary["protocol"].get("segmenter"))


def names_of(summaries: Sequence[dict[str, Any]], free: Collection[str] = ()) -> list[str]:
    """Returns a name for each run: its method, and whatever sets it apart from the others; unique.

    Where tilts differ all say theirs: one of them is an oracle.
    """
    labels = labels_of(summaries, free)
    names = []
    for label, summary in zip(labels, summaries, strict=True):
        peers = [other for other, theirs in zip(summaries, labels, strict=True) if theirs == label]
        differing = [*_differing(("tilt",), summaries), *_differing(FREE, peers)]
        words = [
            f"{key}={summary['protocol'].get(key)}" for key in dict.fromkeys(differing) if key not in free
        ]
        names.append(" ".join(dict.fromkeys([label, *words, *_set_apart(summary, peers)])))
    seen: dict[str, int] = {}
    unique = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        unique.append(f"{name} #{seen[name]}" if names.count(name) > 1 else name)
    return unique


def _differing(keys: Sequence[str], summaries: Sequence[dict[str, Any]]) -> list[str]:
    """Returns the parts of the protocol that some summaries do not agree on."""
    return [key for key in keys if len({str(each["protocol"].get(key)) for each in summaries}) > 1]


def natural(text: str) -> list[tuple[float, str]]:
    """Returns what sorts steps=5 before steps=10."""
    words = re.split(r"(\d+(?:\.\d+)?)", text)
    return [(float(word), "") if number % 2 else (0.0, word) for number, word in enumerate(words)]


def method_name(member: dict[str, Any]) -> str:
    """Returns the method of a run's summary with its variant."""
    method = member["method"]
    return " ".join(filter(None, [method["name"], method.get("variant", "").replace("_", " ")]))


def settings_apart(members: Sequence[dict[str, Any]]) -> list[str]:
    """Returns for each run the settings of its method that other runs of that method have otherwise.

    And those that are not the method's defaults, where these are known (``method.settings``).
    """
    texts = []
    for member, words in zip(members, _words_apart(members, (), ()), strict=True):
        named = {word.partition("=")[0] for word in words}
        changed = member["method"].get("settings", {})
        texts.append(
            " ".join([*words, *(f"{key}={_short(changed[key])}" for key in changed if key not in named)])
        )
    return texts


def labels_of(
    members: Sequence[dict[str, Any]], free: Collection[str], others: Sequence[dict[str, Any]] = ()
) -> list[str]:
    """Returns a name for each run: method, variant, and whatever else differs between runs of that method.

    Args:
        members: Summaries of the runs of a table.
        free: Parts of the protocol that may differ within it.
        others: Summaries of all runs shown: a setting that is not its method's default is named where a run
            of that method in another table has it otherwise.
    """
    words = _words_apart(members, free, others)
    return [" ".join([method_name(member), *mine]) for member, mine in zip(members, words, strict=True)]


def _words_apart(
    members: Sequence[dict[str, Any]], free: Collection[str], others: Sequence[dict[str, Any]]
) -> list[list[str]]:
    """Returns for each run the words of ``labels_of`` beside its method's name."""
    names = [method_name(member) for member in members]
    found = []
    for member, name in zip(members, names, strict=True):
        peers = [other for other, theirs in zip(members, names, strict=True) if theirs == name]
        params = member["method"].get("params", {})
        shown = [_params(other) for other in others if method_name(other) == name]
        changed = member["method"].get("settings", {})
        differing = [
            key
            for key in params
            if any(_params(peer).get(key) != params[key] for peer in peers)
            or (key in changed and any(theirs.get(key) != params[key] for theirs in shown))
        ]
        words = [f"{key}={params[key]}" for key in differing]
        words += [f"{key}={member['protocol'].get(key)}" for key in sorted(free)]
        words += [word for word in _set_apart(member, peers) if word.startswith(_OF_SEGMENTER)]
        found.append(words)
    return found


def _params(member: dict[str, Any]) -> dict[str, Any]:
    params: dict[str, Any] = member["method"].get("params", {})
    return params


def _short(value: Any) -> str:
    """Returns a setting as a word; of a path its last name."""
    return Path(value).name if isinstance(value, str) and "/" in value else str(value)
