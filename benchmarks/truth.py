"""Does a simulated survey come out as it was made? `python -m benchmarks.truth --seeds 0 1 --gnss-std 0.03 0.05`.

Simulates into a temporary folder, runs `jaxba run` as a user would, and compares with the truth that the pipeline has
not seen. An error over its predicted sigma has an RMS of 1 and lies within three in 99.7% where the sigmas are right
and errors normal. What all positions and points have in common, seven directions that the GNSS fixes, is one draw a
survey: their RMS over sigma differs from 1 by chance far more than their number lets expect.

- Positions: of the cameras, an axis; what they have in common in a line of its own.
- Points: height over the true terrain, along its normal.
- Focal length, principal point, distortion: against the lens, and over several seeds whether they are off the same way;
  `rays`: how far its image of a grid of directions lies from the true one, px, the rotation that fits best taken out.
- Check points: the surveyor's marks triangulated in the adjusted block, against true coordinates in the target CRS.
  Their sigmas are those of the marks and, as the block's share, those of tie points around with four views or more.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxba.engine._store import load
from jaxba.geo import geodetic_from_local, local_from_geodetic, local_from_projected
from jaxba.geometry import CAMERAS, AbstractCamera, Pose, triangulate
from jaxba.pipeline import adjust, crs, metadata
from jaxba.scene import Block, LocalFrame
from jaxba.simulation._survey import survey_frame

ROOT = Path(__file__).parents[1]
_MARK_STD_PX, _NEAR, _LEAST_VIEWS = 0.3, 20, 4
_INTRINSICS = {"focal length": ("fx", "fy"), "principal point": ("cx", "cy"), "distortion": ("k1", "k2", "p1", "p2")}


@dataclass(frozen=True)
class Figure:
    """Errors of one kind and their predicted sigmas, all in `unit`; infinite sigmas stand for those not known."""

    name: str
    unit: str
    error: Float[np.ndarray, "*n"]
    std: Float[np.ndarray, "*n"]

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.error**2)))

    @property
    def median_abs(self) -> float:
        return float(np.median(np.abs(self.error)))

    @property
    def over_sigma(self) -> Float[np.ndarray, "*n"]:
        return self.error / self.std

    @property
    def rms_over_sigma(self) -> float:
        return float(np.sqrt(np.mean(self.over_sigma**2)))

    @property
    def robust_over_sigma(self) -> float:
        """What the RMS would be, were all errors as normal as the middle half of them."""
        return float(np.median(np.abs(self.over_sigma)) / 0.6745)

    @property
    def share_within(self) -> float:
        return float(np.mean(np.abs(self.over_sigma) <= 3))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.truth", description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--gnss-std", nargs=2, default=["0.03", "0.05"], metavar=("ACROSS", "UP"))
    parser.add_argument("--cores", type=int, default=2)
    options = parser.parse_args(arguments)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.cores])
    off = []
    for seed in options.seeds:
        with tempfile.TemporaryDirectory() as folder:
            survey, project = Path(folder) / "survey", Path(folder) / "project"
            jaxba = [sys.executable, "-m", "jaxba"]
            begun = time.perf_counter()
            simulate = ["simulate", str(survey), "--seed", str(seed), "--gnss-std", *options.gnss_std]
            subprocess.run([*jaxba, *simulate], cwd=ROOT, check=True, capture_output=True)
            run = ["run", str(survey / "photos"), "--out", str(project), "--workers", str(options.cores)]
            subprocess.run([*jaxba, *run, "--crs", "EPSG:32615"], cwd=ROOT, check=True, capture_output=True)
            seconds = time.perf_counter() - begun
            print(f"Seed {seed}, GNSS {' and '.join(options.gnss_std)} m: {seconds:.0f} s in all\n")
            figures = compare(survey, project)
            print(markdown(figures), end="\n\n", flush=True)
            off.append({figure.name: figure.over_sigma for figure in figures if figure.name in _INTRINSICS})
    if len(off) > 1:
        print(over_seeds(off))


def over_seeds(off: Sequence[Mapping[str, Float[np.ndarray, "*n"]]]) -> str:
    """Return a table of the intrinsics' errors over their sigmas in several surveys: their mean, which tells a bias."""
    lines = ["| parameter | mean error over sigma | expected | RMS over sigma |", "| --- | --- | --- | --- |"]
    for name, members in _INTRINSICS.items():
        values = np.array([one[name] for one in off])
        for k, member in enumerate(members):
            rms = np.sqrt(np.mean(values[:, k] ** 2))
            lines.append(f"| {member} | {values[:, k].mean():+.2f} | 0 +- {len(off) ** -0.5:.2f} | {rms:.2f} |")
    return "\n".join(lines)


def markdown(figures: Sequence[Figure]) -> str:
    """Return a table of errors, and of errors over sigmas."""
    lines = [
        "| what | count | RMS error | median error | RMS over sigma | of the middle half | largest | within 3 sigma |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for figure in figures:
        cells = [figure.name, str(figure.error.size)]
        cells += [f"{value:.2g} {figure.unit}".strip() for value in (figure.rms, figure.median_abs)]
        if np.isfinite(figure.std).all():
            cells += [f"{figure.rms_over_sigma:.2f}", f"{figure.robust_over_sigma:.2f}"]
            cells += [f"{np.abs(figure.over_sigma).max():.1f}", f"{figure.share_within:.2%}"]
        else:
            cells += [""] * 4
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def compare(survey: Path, project: Path) -> tuple[Figure, ...]:
    """Return the errors of a project against the truth of its survey."""
    with np.load(survey / "truth.npz") as file:
        truth = {name: file[name] for name in file.files}
    stages = project / "stages"
    photos = load(stages / "metadata", metadata.Outputs).photos
    frame = load(stages / "crs", crs.Outputs).reference.frame
    found = load(stages / "adjust", adjust.Outputs)
    assert frame is not None
    block = found.block
    names = [Path(photos[i].name).name for i in block.image_index]
    row = [truth["image_name"].tolist().index(name) for name in names]
    position = block.centers_m - local_from_projected(frame, truth["center_in_crs_m"][row])
    mean, std = position.mean(axis=0), found.position_std_m
    figures = [
        Figure("positions", "m", position, std),
        Figure("positions, east, north", "m", position[:, :2], std[:, :2]),
        Figure("positions, up", "m", position[:, 2], std[:, 2]),
        Figure("positions' mean", "m", mean, np.full(3, np.inf)),
        Figure("positions about their mean", "m", position - mean, std),
        *_points(found, frame, truth),
        *_camera(found, truth),
    ]
    for list_name, name in (("gcp_list.txt", "control points"), ("check_list.txt", "check points")):
        figures += _targets(survey / list_name, name, found, frame, names, truth)
    return tuple(figures)


def _points(found: adjust.Outputs, frame: LocalFrame, truth: dict[str, np.ndarray]) -> list[Figure]:
    """Return the points' distances from the terrain."""
    lon, lat, height = geodetic_from_local(frame, found.block.points_m).T
    xyz = local_from_geodetic(survey_frame(), lon, lat, height)
    axes = truth["terrain_north_m"], truth["terrain_east_m"]
    terrain = RegularGridInterpolator(axes, truth["terrain_height_m"].astype(float))
    slope = np.gradient(truth["terrain_height_m"].astype(float), *axes)
    at = xyz[:, 1::-1]
    north, east = (RegularGridInterpolator(axes, part)(at) for part in slope)
    normal = np.stack([-east, -north, np.ones(len(at))], axis=1)
    length = np.linalg.norm(normal, axis=1)
    error = (xyz[:, 2] - terrain(at)) / length
    std = np.sqrt(np.sum((normal / length[:, None] * found.point_std_m) ** 2, axis=1))
    views = np.bincount(found.block.observation_point)
    groups = {"points": views > 0, "points, 2 views": views == 2, "points, 3 to 5 views": (views > 2) & (views < 6)}
    groups["points, 6 or more views"] = views >= 6
    return [Figure(name, "m", error[of], std[of]) for name, of in groups.items() if of.any()]


def _camera(found: adjust.Outputs, truth: dict[str, np.ndarray]) -> list[Figure]:
    names = truth["camera_parameter_name"].tolist()
    own = CAMERAS[found.block.camera_model].parameter_names()
    error = found.block.camera_parameters[0] - truth["camera_parameters"][[names.index(name) for name in own]]
    std = found.intrinsics_std[0]
    figures = []
    for name, members in _INTRINSICS.items():
        index = [own.index(member) for member in members]
        figures.append(Figure(name, "" if name == "distortion" else "px", error[index], std[index]))
    model = CAMERAS["OPENCV"]
    tan = np.stack(np.meshgrid(np.linspace(-0.55, 0.55, 21), np.linspace(-0.4, 0.4, 16)), axis=-1).reshape(-1, 2)
    rays = np.column_stack([tan, np.ones(len(tan))])
    with jax.enable_x64(True):
        true, adjusted = (
            np.asarray(model.from_parameters(jnp.asarray(values)).project(jnp.asarray(rays)))
            for values in (truth["camera_parameters"], found.block.camera_parameters[0])
        )
    focal = truth["camera_parameters"][0]
    x, y = tan.T
    one = np.ones(len(tan))
    turned = focal * np.stack([[x * y, 1 + y**2], [-one - x**2, -x * y], [y, -x]])  # Longuet-Higgins and Prazdny 1980
    matrix = turned.transpose(0, 2, 1).reshape(3, -1).T
    difference = (adjusted - true).reshape(-1)
    difference = difference - matrix @ np.linalg.lstsq(matrix, difference, rcond=None)[0]
    return [*figures, Figure("rays", "px", difference, np.full(difference.shape, np.inf))]


def _targets(
    path: Path,
    name: str,
    found: adjust.Outputs,
    frame: LocalFrame,
    images: Sequence[str],
    truth: dict[str, np.ndarray],
) -> list[Figure]:
    """Return the errors of a list's targets, from their marks."""
    block = found.block
    marks: dict[str, list[tuple[int, float, float]]] = {}
    for line in path.read_text().splitlines()[1:]:
        *_, px, py, image, target = line.split()
        if image in images:
            marks.setdefault(target, []).append((images.index(image), float(px), float(py)))
    views = np.bincount(block.observation_point)
    firm = np.flatnonzero(views >= _LEAST_VIEWS)
    near = KDTree(block.points_m[firm])
    errors, stds = [], []
    for target, rows in marks.items():
        point, own = _triangulated(block, np.array([row[0] for row in rows]), np.array([row[1:] for row in rows]))
        surveyed = truth["target_in_crs_m"][truth["target_name"].tolist().index(target)]
        around = firm[near.query(point, k=_NEAR)[1]]
        errors.append(point - local_from_projected(frame, surveyed[None])[0])
        stds.append(np.sqrt(own**2 + np.median(found.point_std_m[around] ** 2, axis=0)))
    if not errors:
        return []
    return [Figure(name, "m", np.array(errors), np.array(stds))]


@eqx.filter_jit
def _meeting_point(
    camera: AbstractCamera,
    quaternion: Float[np.ndarray, "marks 4"],
    translation_m: Float[np.ndarray, "marks 3"],
    xy_px: Float[np.ndarray, "marks 2"],
    weight: Float[np.ndarray, " marks"],
) -> Float[jax.Array, "3"]:
    return triangulate(Pose(quaternion, translation_m), camera.unproject(xy_px), weight=weight).point


def _triangulated(
    block: Block, image: Int[np.ndarray, " marks"], xy_px: Float[np.ndarray, "marks 2"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the point of marks, and its sigmas that the marks alone account for."""
    rotation = Rotation.from_quat(block.quaternion[image], scalar_first=True).as_matrix()
    # rows of weight zero make all targets of one shape, which is compiled once
    padding = block.num_images - len(image)
    rows, xy = np.pad(image, (0, padding)), np.pad(xy_px, ((0, padding), (0, 0)), mode="edge")
    weight = np.pad(np.ones(len(image)), (0, padding))
    with jax.enable_x64(True):
        camera = CAMERAS[block.camera_model].from_parameters(jnp.asarray(block.camera_parameters[0]))
        point = np.asarray(_meeting_point(camera, block.quaternion[rows], block.translation_m[rows], xy, weight))
    distance = np.linalg.norm(point - block.centers_m[image], axis=1)
    axis = (point - block.centers_m[image]) / distance[:, None]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    focal = block.camera_parameters[0, 0]
    depth = np.einsum("ni,ni->n", rotation[:, 2], point - block.centers_m[image])
    std_m = _MARK_STD_PX * depth / focal
    return point, np.sqrt(np.diag(np.linalg.inv(np.sum(across / std_m[:, None, None] ** 2, axis=0))))


if __name__ == "__main__":
    main()
