"""The README of an export: every file and column with its unit, sign and frame, and what this run's results lack.

The columns are described where they are written, in `jaxba.io`; here stands what holds for several files.
"""

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxba.pipeline.adjust import Outputs as Adjusted
from jaxba.scene import LocalFrame

_WIDTH = 118
_HEIGHTS_FREE = "nothing measured holds heights"


def readme(frame: LocalFrame | None, adjusted: Adjusted, notes: Sequence[str], files: Sequence[str]) -> str:
    """Return the text. `frame`: None for a block without a place on earth. `notes`, `files`: of the export."""
    parts = ["Results of jaxba.", *notes, "FRAMES, UNITS, SIGNS", *_conventions(frame), *_unknown(adjusted), "FILES"]
    return "\n\n".join([*map(_filled, parts), *_files(frame, files)]) + "\n"


def why_empty(
    known: Bool[np.ndarray, "3"],
    num_marks: np.integer,
    adjusted_m: Float[np.ndarray, "3"],
    std_m: Float[np.ndarray, "3"],
) -> str:
    """Return why cells of a point are empty; `known`: the axes that were surveyed.

    >>> why_empty(np.array([True, True, False]), np.int64(3), np.zeros(3), np.array([0.1, 0.1, np.nan]))
    'no surveyed height; no sigma up: nothing measured holds heights'
    """
    why = [] if known[2] else ["no surveyed height"]
    if not np.isfinite(adjusted_m).all():
        few = "used marks in fewer than two adjusted photos" if num_marks < 2 else "its marks' rays do not meet"
        return "; ".join([*why, few])
    return "; ".join([*why, *filter(None, [_without_sigma(std_m[None])])])


def _without_sigma(std_m: Float[np.ndarray, "rows 3"]) -> str:
    """Return along which axes no row has a sigma, and why, in a few words; empty where each axis has some."""
    axes = [axis for axis, column in zip(("east", "north", "up"), std_m.T, strict=True) if np.isnan(column).all()]
    if axes == ["up"]:
        return f"no sigma up: {_HEIGHTS_FREE}"
    return f"no sigma {' '.join(axes)}: not computed" if axes else ""


def _conventions(frame: LocalFrame | None) -> list[str]:
    if frame is None:
        return [
            "Coordinates are in a frame and scale of the block's own. Reprojection errors are lengths in pixels. The "
            "centre of a photo's first pixel is (0.5, 0.5), x to the right and y down."
        ]
    from jaxba import geo

    x, y, _ = geo.grid_from_local(frame, np.zeros((1, 3)))[0][:, 1]
    turn = float(np.degrees(np.arctan2(-x, y)))
    side = "clockwise" if turn >= 0 else "anticlockwise"
    return [
        f"Grid: the target CRS, {frame.crs_name}: x east and y north in the unit {frame.unit}, z in the unit "
        f"{frame.height_unit}.",
        f"True east, north, up: metres along the axes at the survey's origin, latitude {frame.latitude_deg:.9g}, "
        f"longitude {frame.longitude_deg:.9g}, height {frame.height_m:.9g} m. Grid north lies {abs(turn):.4f} degrees "
        f"{side} of true north there (meridian convergence).",
        "Signs: a residual is adjusted minus measured, or adjusted minus surveyed; it is positive where the block lies "
        "farther east, farther north or higher.",
        "Sigmas are standard deviations of one axis along true east, north and up, in metres. Reprojection errors are "
        "lengths in pixels.",
        "Angles are degrees. Omega, phi and kappa are those of the grid: R = Rx(omega) Ry(phi) Rz(kappa) takes the "
        "axes of the camera (x to the right of the photo, y to its top, z backwards) to x, y of the grid and up. Yaw, "
        "pitch and roll are those of a drone's gimbal, from true north: R = Rz(yaw) Ry(pitch) Rx(roll) takes ahead, "
        "right, down of the camera to north, east, down.",
        "The centre of a photo's first pixel is (0.5, 0.5), x to the right and y down.",
    ]


def _unknown(adjusted: Adjusted) -> list[str]:
    """Return why sigmas are missing, where they are."""
    said = []
    for what, std_m in (("cameras", adjusted.position_std_m), ("points", adjusted.point_std_m)):
        if len(std_m) and (why := _without_sigma(std_m)):
            said.append(f"{what} have {why}")
    if not said:
        return []
    told = [str(finding.figures["text"]) for finding in adjusted.findings if finding.kind == "no sigmas"]
    return [f"Empty sigmas: {'; '.join(said)}. {' '.join(told)}".rstrip()]


def _files(frame: LocalFrame | None, files: Sequence[str]) -> list[str]:
    """Return a paragraph for each file that was written, in a fixed order."""
    from jaxba.io import BAR_RESULT_COLUMNS, CLOUD_COLUMNS, CONTROL_COLUMNS, SITE_COLUMNS

    world = "true east, north, up in metres" if frame is not None else "a frame and scale of its own"
    described: dict[str, tuple[str, Mapping[str, str]]] = {
        "cloud.csv": ("the points; cloud.csv.json holds the CRS as WKT and the number of points", CLOUD_COLUMNS),
        "cloud.ply": (
            "the same points as doubles: load it with a global shift where the viewer has one",
            {
                "x, y, z": "as X, Y, Z of cloud.csv, not rounded",
                "red, green, blue": "of the images, 0 to 255",
                "error_px, track_length, point_id": "as in cloud.csv",
                "std_x_m, std_y_m, std_z_m": "as in cloud.csv; NaN where it was not computed",
            },
        ),
        "cloud.laz": (
            "the same points as LAS 1.4 (point format 7) with the CRS in the header, dated by the flight's last photo",
            {
                "X, Y, Z": "as in cloud.csv, to a thousandth of the unit",
                "red, green, blue": "of the images, 16 bits: 255 is 65535",
                "error_px, track_length, point_id": "as in cloud.csv",
                "std_x_m, std_y_m, std_z_m": "as in cloud.csv; NaN where it was not computed",
            },
        ),
        "cloud.png": ("the cloud from above", {}),
        "cameras.gpkg": (
            "where photos were taken, in the target CRS, registered or not; the layer is named cameras",
            SITE_COLUMNS,
        ),
        "cameras.geojson": (
            "the same with longitude, latitude (degrees, WGS 84) and the photos' own heights (metres); columns as in "
            "cameras.gpkg",
            {},
        ),
        "control.csv": ("control and check points", CONTROL_COLUMNS),
        "bars.csv": ("scale bars: known distances between marked points", BAR_RESULT_COLUMNS),
        "colmap": (
            f"the model for COLMAP, as text and binary; its world is {world}, which frame.json describes. POINT3D_ID "
            "is PointID of cloud.csv",
            {
                "QW QX QY QZ TX TY TZ": "x_cam = R x_world + t; the camera has x right, y down, z forward",
                "X, Y": "pixels of images.txt, the first pixel's centre at (0.5, 0.5)",
            },
        ),
        "reconstruction.json": (
            f"the model for OpenSfM; its world is {world}. A point's key is PointID of cloud.csv",
            {
                "rotation, translation": "axis-angle in radians and shift: x_cam = R x_world + t",
                "gps_position": "measured, in the world's frame",
            },
        ),
        "tile.npz": (
            f"the adjustment problem, in {world}: `python -m jaxba solve tile.npz` solves it (into "
            "tile.solved.npz beside this folder) and `python -m jaxba info tile.npz` tells what it holds",
            {},
        ),
    }
    return [
        "\n".join([_filled(f"{name}: {text}."), *_table(columns)])
        for name, (text, columns) in described.items()
        if any(file == name or file.startswith(f"{name}/") for file in files)
    ]


def _table(columns: Mapping[str, str]) -> list[str]:
    width = 2 + max(map(len, columns), default=0)
    return [
        textwrap.fill(meaning, _WIDTH, initial_indent=f"  {name:<{width}}", subsequent_indent=" " * (width + 2))
        for name, meaning in columns.items()
    ]


def _filled(text: str) -> str:
    return textwrap.fill(text, _WIDTH, break_long_words=False, break_on_hyphens=False)
