"""No setting takes NaN or infinity: each is refused by the name that is typed, before any work is done."""

import argparse
import importlib
import math
import re
from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

import pytest

import lodbench
from lodbench.errors import ConfigError
from lodbench.harness.runs.basin import basin_steps
from lodbench.params import options_of
from lodbench.plugins import load_plugin, plugin_names

_ROOT = Path(lodbench.__file__).parent
_SETTINGS = re.compile(r"^class (\w*(?:Params|Options|Settings|Training)|RoughPlace)\b", re.MULTILINE)
# The section of a command line that the settings of a module belong to; the most special one counts.
_SECTIONS = {
    "lodbench.methods.": "method.",
    "lodbench.baselines.": "method.",
    "lodbench.segmentation.": "segmenter.",
    "lodbench.synthesis.views_dataset": "dataset.",
    "lodbench.datasets.published.": "dataset.",
    "lodbench.datasets.prior": "prior.",
    "lodbench.execution.": "executor.",
    "lodbench.harness.remote.": "runner.",
}
# Settings that are not called as their neighbours; of a training, `lodbench train` adds schedule.
_GROUPS = {"LodLocTraining": "", "Perturbation": "world.", "LookRanges": "look."}
# What is an option with dashes, where the option is not the field's name.
_OPTIONS = {
    ("TracedOptions", "map_error_m"): "--map-error",
    ("HeightOptions", "takeoff_m"): "--takeoff",
    ("HeightOptions", "geoid_m"): "--geoid",
    ("HeightOptions", "offset_m"): "--height-offset",
    ("RoughPlace", "latitude_deg"): "--lat",
    ("RoughPlace", "longitude_deg"): "--lon",
    ("RoughPlace", "height_m"): "--height",
    ("RoughPlace", "heading_deg"): "--heading",
    ("RoughPlace", "pitch_deg"): "--pitch",
    ("RoughPlace", "roll_deg"): "--roll",
}
# What is judged elsewhere, and why.
_ELSEWHERE = {
    ("BasinOptions", "ranges"): "by basin_steps, with those of yaw: see below",
    ("BasinOptions", "yaw_ranges"): "likewise",
    ("ViewSettings", "spacing_m"): "made of a method's settings, which are judged; nobody types it",
}
# Refused too, but by the names of the parts that they are handed to.
_NAMED_OTHERWISE = {"FlightsParams": "dataset.shared_m is called horizontal_m of a flight's errors"}


@cache
def _settings() -> dict[str, type]:
    """Returns every dataclass of settings, those within others too, by where it is defined."""
    found = [cls for module in _modules() for cls in vars(module).values() if _is_settings(cls, module)]
    found += [load_plugin("priors", name) for name in plugin_names("priors")]
    for cls in found:
        found += [kind for kind in get_type_hints(cls).values() if is_dataclass(kind) and kind not in found]
    return {f"{cls.__module__}.{cls.__qualname__}": cls for cls in found if any(_numbers(cls))}


def _modules() -> Iterator[Any]:
    for package, folder in (("lodbench", _ROOT), ("lodbench.baselines", _ROOT.parent / "baselines")):
        for path in sorted(folder.rglob("*.py")):
            if _SETTINGS.search(path.read_text("utf-8")):
                words = path.relative_to(folder).with_suffix("").parts
                yield importlib.import_module(".".join([package, *words]).removesuffix(".__init__"))


def _is_settings(cls: object, module: Any) -> bool:
    return (
        isinstance(cls, type)
        and is_dataclass(cls)
        and cls.__module__ == module.__name__
        and _SETTINGS.match(f"class {cls.__name__}") is not None
    )


def _numbers(cls: type) -> Iterator[tuple[str, bool]]:
    """Yields the name of each setting that is a float, or several, and whether it is several."""
    hints = get_type_hints(cls)
    for field in fields(cls):
        words = str(hints[field.name])
        if field.init and "float" in words:
            yield field.name, "list[" in words or "tuple[" in words


def _made(cls: type) -> Any:
    """Returns settings whose mandatory ones are words."""
    must = [f.name for f in fields(cls) if f.init and f.default is f.default_factory is MISSING]
    return cls(**dict.fromkeys(must, "x"))


def _defaults(cls: type) -> Iterator[tuple[str, Any]]:
    """Yields the options of a command, those of its parts too, as none was given."""
    for field in fields(cls):
        if "part" in field.metadata:
            yield from _defaults(field.metadata["part"])
        else:
            yield field.name, None


def _typed(cls: type, name: str) -> str:
    sections = [section for start, section in _SECTIONS.items() if f"{cls.__module__}.".startswith(start)]
    section = _GROUPS.get(cls.__name__, (sections or [""])[-1])
    return _OPTIONS.get((cls.__name__, name), section + name)


def test_all_kinds_of_settings_are_found() -> None:
    words = " ".join(_settings())
    for part in ("flight.params", "UniformPrior", "lodbench.baselines", "HeightOptions", "ReadOptions"):
        assert part in words, part


@pytest.mark.parametrize("where", sorted(_settings()))
@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_no_setting_takes_what_is_no_finite_number(where: str, wrong: float) -> None:
    cls = _settings()[where]
    if any("flags" in field.metadata for field in fields(cls)):  # those of a command
        for name, is_several in _numbers(cls):
            given = argparse.Namespace(**dict(_defaults(cls)) | {name: [wrong] if is_several else wrong})
            with pytest.raises(ConfigError, match=r"^--[a-z-]+=(nan|-?inf) is not finite"):
                options_of(given, cls)
        return
    for name, is_several in _numbers(cls):
        if (cls.__name__, name) in _ELSEWHERE:
            continue
        made = _made(cls)
        others = list(getattr(made, name) or [0.0])[1:] if is_several else []
        with pytest.raises(ConfigError) as refused:
            replace(made, **{name: [wrong, *others] if is_several else wrong})
        if cls.__name__ in _NAMED_OTHERWISE:
            continue
        assert re.search(rf"(?<![\w.-]){re.escape(_typed(cls, name))}\b", refused.value.message), (
            name,
            refused.value.message,
        )


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_no_range_of_a_basin_is_other_than_finite(wrong: float) -> None:
    with pytest.raises(ConfigError, match=r"^ranges="):
        basin_steps([30.0, wrong], [], [None])
    with pytest.raises(ConfigError, match=r"^yaw_ranges="):
        basin_steps([30.0], [wrong], [None])
