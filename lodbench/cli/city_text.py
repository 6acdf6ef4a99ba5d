"""City models in words: what `lodbench city info` and `convert` print for people."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from lodbench.citymodel.codes import finding_catalogue
from lodbench.citymodel.lods import lod_in_words
from lodbench.reporting.aligned_text import count_of, format_columns

if TYPE_CHECKING:
    from lodbench.citymodel.convert import Conversion

_MEANINGS = {str(code): code for code in finding_catalogue()}


def format_info(name: str, info: dict[str, Any]) -> str:
    """Returns the data of ``city_info`` as lines of text."""
    x, y, z = info["extent_m"]
    place = info["center_lat_lon"]
    noun = "building part" if info["parts"] == 1 else "building parts"
    parts = f", and {info['parts']:,} {noun}" if info["parts"] else ""
    lines = [
        name,
        f"format     {info['format']} {info['version'] or ''}".rstrip(),
        f"CRS        {crs_in_words(info['crs'])}",
        *([] if place is None else [f"centre     latitude {place[0]:.5f}, longitude {place[1]:.5f}"]),
        f"extent     {x:,.1f} m x {y:,.1f} m, {z:,.1f} m high",
        f"buildings  {info['buildings']:,}{parts}",
        *_roof_lines(info["pitched_roofs"]),
        *(
            f"{'and' if n == 0 else '':10} {count:,} {name}"
            for n, (name, count) in enumerate(info["objects"].items())
        ),
        "",
        *_level_lines(info["lods"]),
        "",
        *_finding_lines(info["findings"], info["finding_objects"]),
    ]
    return "\n".join(lines)


def _roof_lines(pitched: int) -> list[str]:
    """Returns how many buildings have pitched roofs by an attribute of the file."""
    count = count_of(format(pitched, ","), "buildings")
    return [f"roofs      {count} pitched (from the file)"] if pitched else []


def format_scene(name: str, info: dict[str, Any]) -> str:
    """Returns the data of ``scene_info`` as lines of text."""
    extent = info["extent_m"]
    lines = [
        name,
        f"format     scene, {lod_in_words(info['lod']) if info['lod'] else 'one level'}",
        f"CRS        {crs_in_words(info['crs'])}",
        *([] if extent is None else ["extent     {:,.1f} m x {:,.1f} m, {:,.1f} m high".format(*extent)]),
        f"buildings  {info['buildings']:,}",
        *_roof_lines(info["pitched_roofs"]),
        *(f"{key:10} {info[key]:,}" for key in ("tiles", "triangles") if info[key] is not None),
        "",
        *_finding_lines(info["findings"], info["finding_objects"]),
    ]
    return "\n".join(lines)


def crs_in_words(crs: str | None) -> str:
    """Returns a reference system with its name: ``EPSG:28992 (Amersfoort / RD New)``."""
    if crs is None:
        return "none: local coordinates, taken as metres"
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        return f"{crs} ({CRS.from_user_input(crs).name})"
    except CRSError:
        return crs


def conversion_summary(target: str, done: Conversion) -> dict[str, Any]:
    """Returns what was written as plain values.

    Args:
        target: Where it was written.
        done: What ``convert_city`` returned.
    """
    model, mesh = done.model, done.mesh
    findings = {"findings": done.findings.counts(), "finding_objects": done.findings.objects()}
    summary: dict[str, Any] = {
        "written": target,
        "buildings": len(model.building_ids),
        "parts": model.num_parts,
        "crs": model.crs,
        "left_out": list(done.left_out),
    }
    if mesh is None:
        return summary | {"lods": list(model.lods), "polygons": len(model.polygons)} | findings
    return summary | {
        "lod": mesh.scene.lod,
        "origin": mesh.scene.origin.tolist(),
        "triangles": len(mesh.scene.triangles),
        "area_m2": round(mesh.area_m2, 3),
        "meshed_m2": round(mesh.meshed_m2, 3),
        "lost_m2": round(mesh.lost_m2, 3),
        "excess_m2": round(mesh.excess_m2, 3),
        **findings,
    }


def format_made(made: dict[str, Any]) -> str:
    """Returns what `city make` wrote as lines of text."""
    lines = [f"{made['written']}: LoD 1, {count_of(format(made['buildings'], ','), 'buildings')}"]
    lines += [f"CRS {crs_in_words(made['crs'])}"]
    lines += [f"  {count:>8,}  height from {source}" for source, count in made["heights_from"].items()]
    lines += [f"  {count:>8,}  ground from {source}" for source, count in made["grounds_from"].items()]
    lines += [f"  {count:>8,}  left out: {why}" for why, count in made["left_out"].items()]
    lines += [f"which from where: {made['page']}"]
    return "\n".join([*lines, *_finding_lines(made["findings"], made["finding_objects"])])


def format_conversion(summary: dict[str, Any]) -> str:
    """Returns what was written as lines of text."""
    buildings = count_of(format(summary["buildings"], ","), "buildings")
    if "lods" in summary:
        lods = ", ".join(filter(None, summary["lods"])) or "unnamed"
        parts = f", {count_of(format(summary['parts'], ','), 'parts')}" if summary["parts"] else ""
        what = f"LoD {lods}, {buildings}{parts}, {summary['polygons']:,} polygons"
        lines = [f"{summary['written']}: {what}", f"CRS {crs_in_words(summary['crs'])}"]
    else:
        lod = f"{lod_in_words(summary['lod'])}, " if summary["lod"] else ""
        what = f"{lod}{buildings}, {summary['triangles']:,} triangles"
        origin = " ".join(f"{value:.3f}" for value in summary["origin"])
        areas = "{area_m2:,.2f} m2 in, {meshed_m2:,.2f} m2 meshed".format(**summary)
        areas += ", {lost_m2:,.2f} m2 lost, {excess_m2:,.2f} m2 too much".format(**summary)
        lines = [
            f"{summary['written']}: {what}",
            areas,
            f"origin {origin}, CRS {crs_in_words(summary['crs'])}",
        ]
    lines += [f"left out: {line}" for line in summary["left_out"]]
    return "\n".join([*lines, *_finding_lines(summary["findings"], summary["finding_objects"])])


def _level_lines(lods: dict[str, dict[str, float]]) -> list[str]:
    rows = [["LoD", "polygons", "triangles", "area m2", "meshed m2", "lost m2"]]
    for name, row in lods.items():
        areas = [f"{row.get(key, 0.0):,.2f}" for key in ("area_m2", "meshed_m2", "lost_m2")]
        rows.append([name or "none", f"{row['polygons']:,}", f"{row['triangles']:,}", *areas])
    return format_columns(rows).splitlines()


def _finding_lines(findings: dict[str, int], objects: dict[str, int]) -> list[str]:
    """Returns a line per kind of finding: how often, in how many buildings, and what it means."""
    if not findings:
        return ["findings   none"]
    width = max(map(len, findings))
    kinds = "1 kind" if len(findings) == 1 else f"{len(findings)} kinds"
    rows = [f"findings   {kinds} (which and where: lodbench city check FILE)"]
    rows.append(f"  {'':{width}}  {'count':>8}  {'buildings':>9}")
    for name, count in findings.items():
        places = f"{objects[name]:,}" if objects.get(name) else "-"
        rows.append(f"  {name.ljust(width)}  {count:>8,}  {places:>9}  {_MEANINGS[name].meaning}")
    return rows
