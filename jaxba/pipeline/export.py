"""Stage export: the adjusted block in the target CRS, in the files that other programs read.

Everything before is computed in the local frame; here each point takes the whole way into the target CRS, once.
"""

import dataclasses
import datetime
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxba.engine._parameters import Parameters, parameter
from jaxba.engine._store import sha256
from jaxba.engine._words import many
from jaxba.pipeline import adjust
from jaxba.pipeline._export_readme import readme, why_empty
from jaxba.report import Accuracy, Told, accuracy, accuracy_row, bar_facts
from jaxba.scene import Block, Control, LocalFrame, Photo, Reference, ScaleBars, described

_README = "README.txt"
_WORLD = {False: "arbitrary frame and scale", True: "arbitrary frame, in metres by scale bars"}


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photos`, `reference`, `adjusted`, `control`, `bars`: of the stages before.

    - `folder`: empty; the stage's files go there.
    """

    photos: tuple[Photo, ...]
    reference: Reference
    adjusted: adjust.Outputs
    folder: Path = Path()
    control: Control = field(default_factory=Control.nothing)
    bars: ScaleBars = field(default_factory=ScaleBars.nothing)


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    accuracy_h: float | None = parameter(
        None, low=0.0001, high=100, help="horizontal RMSE that the product is to have by its check points, metres"
    )
    accuracy_v: float | None = parameter(None, low=0.0001, high=100, help="vertical RMSE, likewise")


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """What was written.

    - `files`: names, below the folder. `sha256`: of each. `notes`: what a reader of the files should know.
    - `accuracy`: of the product by its check points; None without any.
    """

    files: tuple[str, ...]
    sha256: tuple[str, ...]
    notes: tuple[str, ...] = ()
    accuracy: Accuracy | None = None


def run(inputs: Inputs, params: Params) -> Outputs:
    """Write the exports.

    Raises `JaxbaError` where a point cannot be had in the target CRS, or a file cannot be written.
    """
    from jaxba import io

    adjusted, folder = inputs.adjusted, inputs.folder
    block = adjusted.block
    frame = inputs.reference.frame if block.is_georeferenced else None
    crs = None if frame is None else _crs_text(frame)
    photos = [inputs.photos[i] for i in block.image_index]
    cloud = io.Cloud(
        xyz=_in_crs(frame, _mapped(inputs, block.points_m)),
        rgb=block.rgb,
        point_id=np.arange(1, block.num_points + 1),
        track_length=np.bincount(block.observation_point, minlength=block.num_points),
        error_px=adjusted.point_error_px,
        std_m=adjusted.point_std_m,
    )
    io.write_csv_cloud(folder / "cloud.csv", cloud, crs)
    io.write_ply(folder / "cloud.ply", cloud, crs)
    if frame is not None and crs is not None:
        date = _flight_date(photos)
        io.write_las(folder / "cloud.laz", cloud, crs, date=date)
        _write_sites(inputs, frame, crs, date)
        _write_control(inputs, frame)
    if inputs.bars.num:
        io.write_csv_bars(folder / "bars.csv", bar_facts(inputs.bars, adjusted.bars))
    _write_colmap(folder / "colmap", inputs, photos, frame)
    gnss = inputs.reference.xyz_m[block.image_index], inputs.reference.std_m[block.image_index]
    io.write_opensfm(folder / "reconstruction.json", block, photos, frame, *gnss)
    notes = [*_notes(inputs, frame), *_name_notes(photos), *_write_tile(inputs)]
    picture, odd = described("The picture cloud.png", lambda: _picture(inputs, cloud, frame), None)
    notes += odd
    if picture is not None:
        _write(folder / "cloud.png", picture)
    target_m = tuple(np.nan if value is None else value for value in (params.accuracy_h, params.accuracy_v))
    found = accuracy(inputs.control, adjusted.control, (float(target_m[0]), float(target_m[1])))
    stated = [] if found is None else [f"Accuracy: {accuracy_row(found.facts())}."]
    names = sorted([*(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()), _README])
    _write(folder / _README, readme(frame, adjusted, [*notes, *stated], names).encode())
    hashes = tuple(sha256(folder / name) for name in names)
    return Outputs(files=tuple(names), sha256=hashes, notes=tuple(notes), accuracy=found)


def lines(outputs: Outputs, told: Told) -> list[str]:
    """Return what was made, in words."""
    return [many(len(outputs.files), "file"), *outputs.notes]


def facts(outputs: Outputs, told: Told) -> dict[str, Any]:
    """Return the files and what a reader of them should know."""
    made = {"export": {"files": list(outputs.files), "notes": list(outputs.notes)}}
    return made if outputs.accuracy is None else made | {"accuracy": outputs.accuracy.facts()}


def _mapped(inputs: Inputs, xyz_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return points of the block as `control.method=affine` maps them; as they are with every other method."""
    affine = inputs.adjusted.affine
    return xyz_m if np.array_equal(affine, np.eye(3, 4)) else xyz_m @ affine[:, :3].T + affine[:, 3]


def _in_crs(frame: LocalFrame | None, xyz_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    from jaxba import geo

    return np.asarray(xyz_m, float) if frame is None else geo.projected_from_local(frame, xyz_m)


def _crs_text(frame: LocalFrame) -> Any:
    from jaxba.io import CrsText

    return CrsText(
        text=frame.crs,
        name=frame.crs_name,
        unit=frame.unit,
        height_unit=frame.height_unit,
        height_note=frame.height_note,
    )


def _flight_date(photos: list[Photo]) -> datetime.date | None:
    """Return the day of the last photo, which files are dated by; None where no photo tells its time."""
    days = [photo.time[:10] for photo in photos if photo.time]
    return datetime.date.fromisoformat(max(days)) if days else None


def _write_sites(inputs: Inputs, frame: LocalFrame, crs: Any, date: datetime.date | None) -> None:
    """Write the cameras, also those that are measured but not registered."""
    from jaxba import geo, io

    adjusted = inputs.adjusted
    sites = io.make_sites(
        adjusted.block,
        inputs.photos,
        inputs.reference,
        std_m=adjusted.position_std_m,
        gnss_residual_m=adjusted.gnss_residual_m,
        error_px=adjusted.error_px,
        grid_from_local=geo.grid_from_local(frame, adjusted.block.centers_m),
    )
    xyz_m = np.where(sites.is_registered[:, None], _mapped(inputs, sites.xyz_m), sites.xyz_m)
    io.write_geopackage(inputs.folder / "cameras.gpkg", sites, _in_crs(frame, xyz_m), crs, date=date)
    geodetic = geo.geodetic_from_local(frame, xyz_m)
    heights = f"Heights are in the photos' own height system ({frame.height_datum}), metres."
    io.write_geojson(inputs.folder / "cameras.geojson", sites, geodetic, description=heights)


def _write_control(inputs: Inputs, frame: LocalFrame) -> None:
    """Write the control and check points, where there are any."""
    from jaxba import io

    control, fit = inputs.control, inputs.adjusted.control
    if not control.num_points:
        return
    known = np.isfinite(control.std_m)
    table = io.ControlTable(
        names=control.names,
        is_check=control.is_check,
        num_marks=fit.num_marks,
        surveyed=np.where(known, _in_crs(frame, control.xyz_m), np.nan),
        adjusted=_in_crs(frame, fit.adjusted_m),
        residual_m=fit.residual_m,
        std_m=fit.std_m,
        mark_rms_px=fit.mark_rms_px,
        over_sigma=fit.over_sigma,
        is_suspect=fit.is_suspect,
        is_set_aside=fit.is_set_aside,
        without_m=fit.without_m,
        detectable_m=fit.detectable_m,
        reach_m=fit.reach_m,
        reasons=[why_empty(*row) for row in zip(known, fit.num_marks, fit.adjusted_m, fit.std_m, strict=True)],
    )
    io.write_csv_control(inputs.folder / "control.csv", table)


def _write_colmap(folder: Path, inputs: Inputs, photos: list[Photo], frame: LocalFrame | None) -> None:
    from jaxba import io

    block, error_px = inputs.adjusted.block, inputs.adjusted.point_error_px
    names = [photo.name for photo in photos]
    sizes = _camera_sizes(block, inputs.photos)
    io.write_colmap_binary(folder / "binary", block, names, sizes, error_px)
    io.write_colmap_text(folder / "text", block, names, sizes, error_px)
    world: dict[str, Any] = {"world": _WORLD[_is_scaled(inputs)]}
    if frame is not None:
        world = {"world": "local east, north, up in metres around the origin", "origin": dataclasses.asdict(frame)}
    _write(folder / "frame.json", (json.dumps(world, indent=1) + "\n").encode())


def _is_scaled(inputs: Inputs) -> bool:
    """Whether scale bars alone have told the block's scale."""
    return not inputs.adjusted.block.is_georeferenced and bool(inputs.adjusted.bars.is_used.any())


def _camera_sizes(block: Block, photos: tuple[Photo, ...]) -> Int[np.ndarray, "cameras 2"]:
    """Return width and height of each camera's images."""
    sizes = {photo.camera: (photo.width_px, photo.height_px) for photo in reversed(photos)}
    for row, index in zip(block.camera_index, block.image_index, strict=True):
        sizes[block.camera_names[row]] = photos[index].width_px, photos[index].height_px
    return np.array([sizes[name] for name in block.camera_names], dtype=np.int64)


def _write_tile(inputs: Inputs) -> list[str]:
    """Write the block as a problem that `jaxba solve` takes; return what it leaves out."""
    from jaxba.ba import PRIORS
    from jaxba.geometry import LOSSES
    from jaxba.io import write_tile
    from jaxba.sfm import add_bars, control_part, to_problem, weighed

    adjusted = inputs.adjusted
    block = adjusted.block
    control = dataclasses.replace(inputs.control, mark_std_px=adjusted.mark_std_px)
    part = control_part(block, control, adjusted.mark_used, adjusted.control.used_std_m)
    problem = to_problem(
        block,
        inputs.reference,
        inputs.photos,
        std_px=adjusted.std_px,
        position_scale=adjusted.position_scale,
        control=part,
        common=adjusted.common,
    )
    if adjusted.flights is not None:
        problem = dataclasses.replace(problem, position_offset=np.nan_to_num(adjusted.flights.offset_m))
    problem = add_bars(problem, block, inputs.bars, adjusted.bars.is_used, control, part)
    problem = weighed(problem, adjusted.spread, block.num_observations)
    known = tuple(prior for prior in problem.priors if type(prior) in PRIORS.values())
    left = [prior.name for prior in problem.priors if type(prior) not in PRIORS.values()]
    loss = LOSSES[adjusted.loss](f_scale=adjusted.loss_f_scale)
    write_tile(inputs.folder / "tile.npz", dataclasses.replace(problem, priors=known), loss=loss)
    notes = [f"tile.npz leaves out the priors that its format has no arrays for: {', '.join(left)}."] if left else []
    notes.append("tile.npz has the sigmas and the loss that the results' sigmas follow from.")
    if adjusted.control.method in ("helmert", "affine"):
        notes.append(
            "tile.npz starts at the block as it was fitted to control afterwards, and holds none: solving it takes the "
            "block back to what holds it without control."
        )
    return notes


def _picture(inputs: Inputs, cloud: Any, frame: LocalFrame | None) -> bytes:
    from jaxba.report import Picture, draw_picture

    block = inputs.adjusted.block
    photos = [inputs.photos[i] for i in block.image_index]
    order = range(len(photos))
    if all(photo.time for photo in photos):
        order = sorted(order, key=lambda k: (photos[k].time, photos[k].name))
    unit = "" if frame is None else _short(frame.unit)
    figures = f"{block.num_observations:,} observations, median error {inputs.adjusted.median_px:.2f} px"
    return draw_picture(
        Picture(
            xyz=cloud.xyz,
            rgb=cloud.rgb,
            error_px=cloud.error_px,
            camera_xyz=_in_crs(frame, _mapped(inputs, block.centers_m))[list(order)],
            title=f"{block.num_images} of {len(inputs.photos)} photos, {block.num_points:,} points",
            subtitle=figures,
            crs=_WORLD[_is_scaled(inputs)] if frame is None else _named(frame),
            unit=unit,
            height_label="Z" if frame is None else f"height ({_short(frame.height_unit)}, {_above(frame)})",
        )
    )


def _named(frame: LocalFrame) -> str:
    return f"{frame.crs_name} ({frame.crs})" if frame.crs.startswith("EPSG:") else frame.crs_name


def _above(frame: LocalFrame) -> str:
    """Return in two words what heights in the CRS are above, as far as its name or the photos' datum tells."""
    from pyproj import CRS

    if CRS(frame.crs).is_compound:
        return CRS(frame.crs).sub_crs_list[1].name
    return {"mean_sea_level": "above mean sea level", "unknown": "datum unknown"}.get(
        frame.height_datum, frame.height_datum
    )


def _short(unit: str) -> str:
    return {"metre": "m", "US survey foot": "US ft", "foot": "ft"}.get(unit, unit)


def _notes(inputs: Inputs, frame: LocalFrame | None) -> list[str]:
    if frame is not None:
        notes = [f"Coordinates are in {_named(frame)}, unit {frame.unit}. {frame.height_note}"]
        if inputs.adjusted.control.method == "affine":
            notes.append(
                "The clouds and the cameras' places are mapped by twelve parameters onto control "
                "(control.method=affine). Poses cannot be: COLMAP's and OpenSfM's models and tile.npz have the "
                "similarity alone."
            )
        return notes
    own = "a frame, in metres by scale bars," if _is_scaled(inputs) else "a frame and scale"
    why = "no photo has a position that can be used"
    if inputs.reference.frame is not None:
        why = "the block could not be placed by the photos' positions or control points"
    return [
        f"No coordinates on earth: {why}. Clouds and cameras are in {own} of their own, without an EPSG "
        "code; cloud.laz, cameras.gpkg and cameras.geojson, which need a CRS, are left out. "
        "Give positions with geo.txt, or control points with --gcp."
    ]


def _name_notes(photos: list[Photo]) -> list[str]:
    spaced = [photo.name for photo in photos if " " in photo.name]
    if not spaced:
        return []
    return [
        f"COLMAP's text ends a photo's name at a space: {len(spaced)} names have %20 for it in colmap/text, first "
        f"{spaced[0]!r}; colmap/binary has them as they are."
    ]


def _write(path: Path, content: bytes) -> None:
    from jaxba._atomic import write_atomically

    with write_atomically(path) as file:
        file.write(content)
