"""`jaxba plan`: what a flight would give before it is flown, or what more would have given a project."""

import contextlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.cli._progress import overwritten
from jaxba.cli._solve import tile_of
from jaxba.cli._text import many, to_json, wrapped
from jaxba.design import (
    MOST_POINTS,
    Control,
    FlightPlan,
    Network,
    Place,
    Stations,
    forecast,
    gains,
    improved,
    network_of,
    network_of_block,
    read_plan,
    stations_of,
)
from jaxba.engine._compile_cache import use_compilation_cache
from jaxba.engine._project import is_project
from jaxba.io import problem_of_bytes, read_bytes
from jaxba.pipeline import PIPELINE
from jaxba.report import recorded

_LABEL, _NAME, _FIGURE = 11, 52, 11


def run(what: Path, *, improve: str | None, points: int, as_json: bool, quiet: bool) -> int:
    """Tell what a plan or a project would give; return 0."""
    if not 1 <= points <= MOST_POINTS:
        raise JaxbaError(f"--points {points}: give from 1 to {MOST_POINTS} control points.")
    use_compilation_cache()
    is_shown = sys.stderr.isatty() and not quiet and not as_json
    with overwritten() if is_shown else contextlib.nullcontext(lambda text: None) as say:
        say("laying out the block ...")
        if what.is_dir() and is_project(what):
            network, place, control, about = _of_project(what)
        else:
            plan = read_plan(what)
            network, place, control, about = network_of(plan), plan.place, plan.control, _about(plan, stations_of(plan))
        told = _told(network, place, control, points if improve else 0, say)
    told = {"input": str(what), **about, **told}
    if as_json:
        print(to_json(told))
    elif not quiet:
        print(text(told))
    return 0


def _told(network: Network, place: Place, control: Control, points: int, say: Callable[[str], None]) -> dict[str, Any]:
    say("sigmas over the area ...")
    told = forecast(network)
    ground = told["ground"]
    ground["worst_at"] = place.coordinates(np.array([ground.pop("worst_at_m")]))[0].tolist()
    told["unit"] = place.unit
    told["gains"] = gains(network, control, lambda name: say(f"{name} ..."))
    if points:
        say("places for control points ...")
        told["improve"] = improved(network, points, control, place)
    return told


def _about(plan: FlightPlan, stations: Stations) -> dict[str, Any]:
    """Return what the plan itself says, in figures."""
    import shapely

    camera, flight = plan.camera, plan.flight
    a_pixel = flight.height_m / camera.focal
    return {
        "area_m2": float(shapely.Polygon(plan.area_m).area),
        "lines": stations.num_lines,
        "length_m": stations.length_m,
        "height_m": flight.height_m,
        "gsd_m": a_pixel,
        "base_m": a_pixel * camera.height_px * (1 - flight.forward_overlap),
        "spacing_m": a_pixel * camera.width_px * (1 - flight.side_overlap),
        "gnss": plan.gnss.kind,
        "gnss_std_m": list(plan.gnss.std_m),
        "gnss_common_std_m": list(plan.gnss.common_std_m),
        "control": len(plan.control_m),
        "focal_px": camera.focal,
    }


def _of_project(folder: Path) -> tuple[Network, Place, Control, dict[str, Any]]:
    found = recorded(folder, PIPELINE)
    tile = tile_of(folder)
    done = found.done
    if done.adjust is None:
        raise JaxbaError(f"{folder}: its adjustment is out of date or missing; run the same command again.")
    held = problem_of_bytes(read_bytes(tile), str(tile))
    sizes = np.array([[photo.width_px, photo.height_px] for photo in done.photos])
    width, height = np.median(sizes, axis=0).astype(int).tolist()
    try:
        network = network_of_block(held.problem, (width, height), done.adjust.mark_std_px, held.loss)
    except JaxbaError as error:
        raise JaxbaError(f"{folder}: {error}") from None
    if not done.adjust.block.is_georeferenced:
        raise JaxbaError(
            f"{folder}: its block has no place and no scale to foretell sigmas in; give control points or photos with "
            "positions, and run again."
        )
    place = Place(done.control.reference.frame)
    focal = float(np.median(done.adjust.block.camera_parameters[:, 0]))
    return network, place, Control(), {"control": int(done.control.control.num_points), "focal_px": focal}


def text(told: dict[str, Any]) -> str:
    """Return the forecast as a person reads it."""
    ground, rows = told["ground"], []
    flight = many(told["photos"], "photo")
    if "lines" in told:
        flight += (
            f" on {many(told['lines'], 'line')}, {told['length_m'] / 1000:.1f} km, for {told['area_m2'] / 1e4:.2f} ha; "
            f"{100 * told['gsd_m']:.2f} cm/px, lines {told['spacing_m']:.1f} m apart, a photo every "
            f"{told['base_m']:.1f} m"
        )
        common = _metres(told["gnss_common_std_m"]) if max(told["gnss_common_std_m"]) else "nothing"
        rows.append(("positions", f"{told['gnss']}: {_metres(told['gnss_std_m'])} each, in common {common}"))
    rows.insert(0, ("flight", flight))
    rows.append(("control", many(told["control"], "point")))
    low, usual = ground["rays"]
    worst = ", ".join(f"{value:.{_digits(told['unit'])}f}" for value in ground["worst_at"])
    rows += [
        ("ground", f"sigma {_metres(ground['median_std_m'])} in the median"),
        ("", f"      {_metres(ground['worst_std_m'])} at worst; the worst place is {worst} ({told['unit']})"),
        ("", f"seen in {usual:.0f} photos, at least {low:.0f}"),
        ("cameras", f"sigma {_metres(told['cameras']['median_std_m'])} in the median"),
        ("focal", f"sigma {told['focal_std_px']:.2f} px, {told['focal_std_px'] / told['focal_px']:.3%}"),
        ("as a whole", f"the area may be off by {_metres(told['shift_std_m'])} (sigma)"),
        ("dome", f"its middle against its corners: {_length(told['dome_std_m'])} of height (sigma)"),
    ]
    for k, mode in enumerate(told["modes"]):
        said = f"{mode['name']}: {_metres(mode['corners_m'])} at a corner"
        if mode["name"] not in ("tilt", "turn", "scale"):
            said += f", {_metres(mode['middle_m'])} in the middle"
        rows.append(("" if k else "weakest", said))
    lines = [wrapped(label, said, _LABEL) for label, said in rows]
    titles = ("photos", "median up", "worst", "dome", "focal px")
    lines += ["", f"{'what more would gain':<{_NAME}}" + "".join(f"{title:>{_FIGURE}}" for title in titles)]
    for row in told["gains"]:
        if "none" in row:
            lines.append(f"{row['name']:<{_NAME}}  {row['none']}")
            continue
        lengths = (row["median_std_m"][2], row["worst_std_m"], row["dome_std_m"])
        figures = (str(row["photos"]), *map(_length, lengths), f"{row['focal_std_px']:.2f}")
        lines.append(f"{row['name']:<{_NAME}}" + "".join(f"{figure:>{_FIGURE}}" for figure in figures))
    if "improve" in told:
        lines += ["", *_improvement(told["improve"])]
    return "\n".join(lines)


def _improvement(found: dict[str, Any]) -> list[str]:
    digits = _digits(found["unit"])
    lines = [
        f"{many(len(found['points']), 'more control point')}, where they help most: the worst sigma falls from "
        f"{_length(found['worst_before_m'])} to {_length(found['worst_std_m'])}, the median from "
        f"{_length(found['typical_before_m'])} to {_length(found['typical_std_m'])}.",
        f"{'point':<8}{'x':>16}{'y':>16}  worst without it   ({found['unit']})",
    ]
    for point in found["points"]:
        x, y = (f"{point[name]:>16.{digits}f}" for name in "xy")
        lines.append(f"{point['name']:<8}{x}{y}  {_length(point['without_m'])}")
    return lines


def _digits(unit: str) -> int:
    return 6 if unit.startswith("degrees") else 1


def _metres(values: list[float]) -> str:
    return ", ".join(_length(value).removesuffix(" m") for value in values) + " m east, north, up"


def _length(value: float) -> str:
    """Return metres with three figures that count, and no finer than a tenth of a millimetre."""
    return (
        f"{value:.1f} m"
        if value >= 100
        else f"{value:.2f} m"
        if value >= 1
        else f"{value:.4f} m"
        if value < 0.01
        else f"{value:.3f} m"
    )
