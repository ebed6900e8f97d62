"""Large surveys through tracks, start and adjust: `python -m benchmarks.surveys --photos 250 500 1000 1500`.

Simulated blocks with 7000 observations a photo, as photos of 20 megapixels have them: their features (SIFT's length, as
many false ones again), and a view graph with the matches of every two photos of a track. Each survey goes through the
three stages as `jaxba run` calls them, in a process of its own, and the peak of memory of each stage is printed.

`--rounds`, `--ftol`: of the adjustment, `adjust.max_rounds` and `adjust.ftol`. `--observations`: of a photo.
`--max-memory`: what solving in tiles may hold. `--whole`: surveys that are adjusted in one piece as well; prints the
largest distance of their cameras and points from those of the tiles.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from scipy.spatial.transform import Rotation

from jaxba import sfm
from jaxba._sizes import bytes_of
from jaxba.engine._compile_cache import use_compilation_cache
from jaxba.engine._room import Room
from jaxba.pipeline import adjust, start, tracks
from jaxba.scene import EdgeStatus, Features, LocalFrame, Photo, Reference, ViewGraph
from jaxba.simulation import Survey, uav_block

_LENGTH = 4.0  # of tracks
_GNSS_M = (0.02, 0.02, 0.04)
_LEAST_MATCHES = 30  # of an edge
_FRAME = LocalFrame(
    latitude_deg=50.0, longitude_deg=-0.1, height_m=30.0, crs="EPSG:32630", epsg=32630,
    crs_name="WGS 84 / UTM zone 30N", unit="metre", height_note="simulated",
)  # fmt: skip


class SimulatedFeatures(Mapping[int, Features]):
    """Features of each image, made when they are asked for, as a project's are read then."""

    def __init__(self, survey: Survey) -> None:
        seen = survey.problem.observations
        image = np.asarray(seen.image_index)
        self.rows = np.split(np.argsort(image, kind="stable"), np.cumsum(np.bincount(image))[:-1])
        self.point, self.xy_px = np.asarray(seen.point_index), np.asarray(seen.xy_px)
        self.size_px = survey.truth.image_size_px
        self.known = np.random.default_rng(0).integers(0, 120, (8191, 128), dtype=np.uint8)

    def __getitem__(self, image: int) -> Features:
        rng, rows = np.random.default_rng(image), self.rows[image]
        false = rng.integers(0, 120, (len(rows), 128), dtype=np.uint8)
        true = self.known[self.point[rows] % len(self.known)] + rng.integers(0, 12, false.shape, dtype=np.uint8)
        xy_px = np.concatenate([self.xy_px[rows], rng.uniform(0, self.size_px, (len(rows), 2))])
        ones = np.ones(len(xy_px))
        return Features(
            detector="sift", xy_px=xy_px, size_px=ones, angle_rad=ones, descriptors=np.concatenate([true, false]),
            rgb=np.zeros((len(xy_px), 3), np.uint8), mean_brightness=100.0, coverage=1.0,
        )  # fmt: skip

    def __iter__(self) -> Iterator[int]:
        return iter(range(len(self.rows)))

    def __len__(self) -> int:
        return len(self.rows)

    def view_graph(self, survey: Survey) -> ViewGraph:
        """Return the matches of every two images of a point, with relative poses that are off by a degree."""
        number = np.empty(len(self.point), np.int32)
        for rows in self.rows:
            number[rows] = np.arange(len(rows))
        image = np.asarray(survey.problem.observations.image_index)
        order = np.lexsort((image, self.point))
        pairs, matches = [], []
        for step in range(1, len(order)):
            same = np.flatnonzero(self.point[order[step:]] == self.point[order[:-step]])
            if not len(same):
                break
            first, second = order[same], order[same + step]
            pairs.append(np.stack([image[first], image[second]], axis=1).astype(np.int32))
            matches.append(np.stack([number[first], number[second]], axis=1))
        of_match, match = np.concatenate(pairs), np.concatenate(matches)
        key = of_match[:, 0].astype(np.int64) * len(self.rows) + of_match[:, 1]
        order = np.argsort(key, kind="stable")
        found, counts = np.unique(key[order], return_counts=True)
        kept = counts >= _LEAST_MATCHES
        match, counts = match[order[np.repeat(kept, counts)]], counts[kept]
        edge = np.stack([found[kept] // len(self.rows), found[kept] % len(self.rows)], axis=1)
        return _with_poses(survey, edge, match, counts)


def _with_poses(survey: Survey, pairs: np.ndarray, matches: np.ndarray, counts: np.ndarray) -> ViewGraph:
    rng, count = np.random.default_rng(1), len(pairs)
    true = Rotation.from_quat(np.asarray(survey.truth.poses.quaternion), scalar_first=True)
    translation = np.asarray(survey.truth.poses.translation)
    relative = true[pairs[:, 1]] * true[pairs[:, 0]].inv()
    shift = translation[pairs[:, 1]] - relative.apply(translation[pairs[:, 0]])
    direction = shift / np.linalg.norm(shift, axis=1, keepdims=True) + 0.01 * rng.normal(size=(count, 3))
    turned = Rotation.from_rotvec(0.005 * rng.normal(size=(count, 3))) * relative
    return ViewGraph(
        pairs=pairs.astype(np.int32),
        status=np.full(count, EdgeStatus.GOOD, np.uint8),
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        matches=matches.astype(np.int32),
        num_putative=(2 * counts).astype(np.int32),
        is_planar=np.zeros(count, bool),
        quaternion=turned.as_quat(canonical=True, scalar_first=True),
        direction=direction / np.linalg.norm(direction, axis=1, keepdims=True),
        residual_px=np.full(count, 0.5),
        distinctiveness=np.full(count, 0.5),
        angle_rad=np.full(count, 0.2),
    )


def _given(num_photos: int, observations: int) -> tuple[tuple[Photo, ...], Reference, SimulatedFeatures, ViewGraph]:
    survey = uav_block(
        num_photos, seed=1, points_per_image=observations / _LENGTH, mean_track_length=_LENGTH, gnss_std_m=_GNSS_M,
        outlier_fraction=0.01,
    )  # fmt: skip
    truth, prior = survey.truth, survey.problem.prior("position")
    focal_px = float(np.ravel(truth.cameras.focal_and_center()[0])[0])
    width, height = truth.image_size_px
    photos = tuple(
        Photo(
            name=f"{k:04d}.jpg", path=Path(f"{k:04d}.jpg"), sha256="0", width_px=width, height_px=height, camera="c",
            focal_px=1.01 * focal_px, focal_source="focal_plane",
        )
        for k in range(num_photos)
    )  # fmt: skip
    unknown = np.full((num_photos, 3), np.nan)
    reference = Reference(
        frame=_FRAME, xyz_m=np.asarray(prior.xyz), std_m=np.asarray(prior.std_m),
        quaternion=np.full((num_photos, 4), np.nan), attitude_std_rad=unknown, is_used=np.ones(num_photos, bool),
        height_above_ground_m=np.full(num_photos, np.nan),
    )  # fmt: skip
    features = SimulatedFeatures(survey)
    return photos, reference, features, features.view_graph(survey)


class _Stage:
    """Prints a stage's seconds and its peak of memory, above what was there before any of them."""

    def __init__(self, name: str, before_gb: float) -> None:
        self.name, self.before_gb = name, before_gb

    def __enter__(self) -> None:
        Path("/proc/self/clear_refs").write_text("5")  # the peak so far is forgotten
        self.begun = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        seconds, peak = time.perf_counter() - self.begun, _gb("VmHWM")
        print(f"{self.name:<8} {seconds:7.1f} s   peak {peak:.2f} GB, {self.before_gb:.2f} before", flush=True)


def _gb(field: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field)) / 1e6


def _one(num_photos: int, observations: int, max_memory: str, whole: bool, into: Path, params: adjust.Params) -> None:
    use_compilation_cache()
    photos, reference, features, view_graph = _given(num_photos, observations)
    before_gb = _gb("VmRSS")
    with _Stage("tracks", before_gb):
        tracked = tracks.run(tracks.Inputs(photos=photos, features=features, view_graph=view_graph), tracks.Params())
    print(f"         {tracked.tracks.num_observations:,} observations, {len(view_graph.matches):,} matches", flush=True)
    given: dict[str, Any] = {
        "photos": photos, "reference": reference, "view_graph": view_graph, "tracks": tracked.tracks,
    }  # fmt: skip
    with _Stage("start", before_gb):
        block = start.run(start.Inputs(**given), start.Params()).block
    tiling = mock.patch.object(sfm.Tiling, "applies", lambda *_: not whole)
    with _Stage("adjust", before_gb), tiling:
        chunk_size = 500 if num_photos > 500 else None
        inputs = adjust.Inputs(**given, block=block, features=features, chunk_size=chunk_size)
        room = Room(bytes_of(max_memory, 1.0), into.parent)
        found = adjust.run(inputs, params, room)
    print(f"         {adjust.lines(found, _nothing_told(photos))[0]}", flush=True)
    np.savez(into, centers_m=found.block.centers_m, points_m=found.block.points_m, std_m=found.point_std_m)


def _nothing_told(photos: tuple[Photo, ...]) -> Any:
    return argparse.Namespace(photos=[photo.name for photo in photos], left_out=())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", type=int, nargs="*", default=[250, 500, 1000, 1500])
    parser.add_argument("--whole", type=int, nargs="*", default=[250])
    parser.add_argument("--max-memory", default="5GB")
    parser.add_argument("--observations", type=int, default=7000)
    parser.add_argument("--rounds", type=int, default=adjust.Params().max_rounds)
    parser.add_argument("--ftol", type=float, default=adjust.Params().ftol)
    parser.add_argument("--one", nargs=5, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        num_photos, observations, max_memory, whole, into = options.one
        params = adjust.Params(max_rounds=options.rounds, ftol=options.ftol, xtol=min(options.ftol, 1e-8))
        _one(int(num_photos), int(observations), max_memory, whole == "True", Path(into), params)
        return
    with tempfile.TemporaryDirectory() as folder:
        for num_photos in options.photos:
            for whole in (False, True) if num_photos in options.whole else (False,):
                print(f"{num_photos} photos, in {'one piece' if whole else f'tiles, {options.max_memory}'}", flush=True)
                sizes = str(num_photos), str(options.observations)
                one = [*sizes, options.max_memory, str(whole), f"{folder}/{whole}.npz"]
                of_rounds = ["--rounds", str(options.rounds), "--ftol", str(options.ftol)]
                subprocess.run([sys.executable, "-m", "benchmarks.surveys", *of_rounds, "--one", *one], check=True)
            if num_photos in options.whole:
                tiled, piece = (np.load(f"{folder}/{whole}.npz") for whole in (False, True))
                apart = ", ".join(f"{name} {np.abs(tiled[name] - piece[name]).max():.1e}" for name in tiled)
                print(f"largest difference of tiles and one piece: {apart}")


if __name__ == "__main__":
    main()
