"""Does an audit name the fault of a model, and nothing else? `python -m benchmarks.audits --seeds 20`.

Models of COLMAP's own making are audited clean, with one fault planted, with control points, and with two of these
exchanged. A case is right where the planted fault is the only one that is named, and a clean model has none.
"""

import argparse
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from jaxba.audit import audit

FOCAL_PX, SIZE_PX = 1280.0, (1024, 768)
NOISE_PX = 0.5


def clean(seed: int = 1) -> pycolmap.Reconstruction:
    """Return ten images by one camera around a cloud of points, with noise in their pixels, as COLMAP adjusts them."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=10, num_points3D=300, track_length=6,
        num_points2D_without_point3D=3,
    )  # fmt: skip
    model = pycolmap.synthesize_dataset(options)
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=NOISE_PX), model)
    pycolmap.bundle_adjustment(model)
    model.update_point_3d_errors()
    return model


def written(folder: Path, model: pycolmap.Reconstruction, *, text: bool = False) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder))
    return folder


def with_focal_off(model: pycolmap.Reconstruction) -> None:
    """Make the focal length 5% too long."""
    camera = model.camera(1)
    camera.params = camera.params * np.array([1.05, 1, 1, 1])


def with_camera_shifted(model: pycolmap.Reconstruction) -> str:
    """Move one image by a twentieth of the block; return its name."""
    frame = model.frame(4)
    pose = frame.rig_from_world
    center = pose.inverse().translation
    centers = [f.rig_from_world.inverse().translation for f in model.frames.values()]
    extent = np.linalg.norm(np.std(centers, axis=0))
    center = center + extent / 20 * np.array([0.6, 0.0, 0.8])
    frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, -pose.rotation.matrix() @ center)
    return next(image.name for image in model.images.values() if image.frame_id == 4)


def with_wrong_matches(model: pycolmap.Reconstruction, share: float = 0.02) -> int:
    """Put that share of the observations elsewhere in their images; return how many."""
    rng = np.random.default_rng(3)
    seen = [
        (image, k) for _, image in sorted(model.images.items()) for k, p in enumerate(image.points2D) if p.has_point3D()
    ]
    chosen = rng.choice(len(seen), round(share * len(seen)), replace=False)
    for number in chosen:
        image, k = seen[number]
        image.points2D[k].xy = rng.uniform([0, 0], SIZE_PX)
    return len(chosen)


PLANTS: dict[str, Callable[[pycolmap.Reconstruction], object]] = {
    "focal": with_focal_off,
    "camera": with_camera_shifted,
    "matches": with_wrong_matches,
}


def control_list(
    model: pycolmap.Reconstruction, *, exchanged: tuple[str, str] = ("", ""), crs: str = "EPSG:32615\n"
) -> str:
    """Return a gcp_list.txt of eight points in the cloud, 10 m a unit of the model, which is turned in space.

    - `exchanged`: two points that have each other's coordinates. `crs`: its first line.
    """
    rng = np.random.default_rng(5)
    turn = pycolmap.Rotation3d(np.array([0.3, -0.5, 0.2])).matrix()
    points = [model.points3D[k].xyz for k in sorted(model.points3D)[:8]]
    surveyed = {f"g{k}": 10.0 * turn @ point + [576300.0, 5183400.0, 300.0] for k, point in enumerate(points)}
    surveyed = {name: xyz + rng.normal(0, [0.02, 0.02, 0.03]) for name, xyz in surveyed.items()}
    rows = []
    for name, point in zip(list(surveyed), points, strict=True):
        for _, image in sorted(model.images.items())[:6]:
            seen = image.project_point(point)
            if seen is not None and np.all((seen > 0) & (seen < SIZE_PX)):
                x, y = seen + rng.normal(0, 0.3, 2)
                other = dict([exchanged, exchanged[::-1]]).get(name, name)
                rows.append("{:.4f} {:.4f} {:.4f} ".format(*surveyed[other]) + f"{x:.3f} {y:.3f} {image.name} {name}")
    return crs + "\n".join(rows) + "\n"


_NAMED = {"focal": "intrinsics off", "camera": "images off", "matches": "wrong matches"}
_WHAT = {
    "clean": "no fault",
    "focal": "focal length 5% too long",
    "camera": "one camera shifted by a twentieth of the block",
    "matches": "2% of the observations wrong",
    "control": "eight control points, no fault",
    "exchanged": "two control points exchanged",
}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.audits", description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    options = parser.parse_args(arguments)
    print("| planted | models | named alone |\n| --- | --- | --- |")
    for case, what in _WHAT.items():
        right = sum(is_right(case, seed) for seed in range(options.seeds))
        print(f"| {what} | {options.seeds} | {right} |", flush=True)


def is_right(case: str, seed: int) -> bool:
    """Return whether the audit of a model names what was planted, and nothing else."""
    model, gcp = clean(seed), None
    if case in PLANTS:
        PLANTS[case](model)
        model.update_point_3d_errors()
    expected = [_NAMED[case]] if case in _NAMED else []
    with tempfile.TemporaryDirectory() as folder:
        if case in ("control", "exchanged"):
            gcp = Path(folder) / "gcp_list.txt"
            exchanged = ("g1", "g5") if case == "exchanged" else ("", "")
            gcp.write_text(control_list(model, exchanged=exchanged))
            expected = ["control labels exchanged"] if case == "exchanged" else []
        found = audit(written(Path(folder) / "model", model), Path(folder) / "audit", gcp=gcp)
    return [fault.kind for fault in found.faults] == expected


if __name__ == "__main__":
    main()
