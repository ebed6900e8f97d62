"""From photos to points beside COLMAP, on the same images in one run: `python -m benchmarks.photos brighton seneca40`.

Each side is a process of its own with all that a user waits for, imports and compiling included: jaxba's whole pipeline
into an empty project, and pycolmap's features, exhaustive matching and incremental mapping with one SIMPLE_RADIAL
camera, its defaults else, on as many threads as jaxba has workers. Points seen three times or more are counted for
both, and errors by one definition: the median over observations of the distance in pixels.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
IMAGES = Path(os.environ.get("JAXBA_DATA") or ROOT.parent / "shared" / "data") / "images"
RESULTS = Path(__file__).parent / "results"
_STAGES = ("metadata", "crs", "pairs", "features", "match", "tracks", "start", "adjust", "export")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.photos", description=__doc__)
    parser.add_argument("sets", nargs="+", help=f"folders below {IMAGES}, or others")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument(
        "--colmap", type=Path, help=argparse.SUPPRESS
    )  # in a process of its own: the folder to write to
    options = parser.parse_args(arguments)
    if options.colmap is not None:
        print(json.dumps(colmap(Path(options.sets[0]), options.colmap, options.cores)))
        return
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.cores])
    print(_HEADER)
    for name in options.sets:
        photos = Path(name) if Path(name).is_dir() else IMAGES / name
        result = compare(photos, options.cores)
        (RESULTS / f"photos_{photos.name}.json").write_text(json.dumps(result, indent=1) + "\n")
        for side in ("jaxba", "colmap"):
            print(_line(photos.name, side, result), flush=True)


def compare(photos: Path, cores: int) -> dict[str, Any]:
    """Return the figures of both sides, ready for JSON."""
    with tempfile.TemporaryDirectory() as folder:
        own = jaxba(photos, Path(folder) / "project", cores)
        command = [sys.executable, "-m", "benchmarks.photos", str(photos), "--colmap", f"{folder}/colmap"]
        begun = time.perf_counter()
        done = subprocess.run([*command, "--cores", str(cores)], cwd=ROOT, capture_output=True, text=True, check=True)
        peer = json.loads(done.stdout.splitlines()[-1])
        peer["seconds"] = time.perf_counter() - begun
    versions = {name: version(name) for name in ("jax", "opencv-python-headless", "poselib", "pycolmap")}
    return {"set": photos.name, "cores": cores, "versions": versions, "jaxba": own, "colmap": peer}


def jaxba(photos: Path, project: Path, cores: int) -> dict[str, Any]:
    """Run `jaxba run` on an empty project and return its figures."""
    command = [sys.executable, "-m", "jaxba", "run", str(photos), "--out", str(project), "--workers", str(cores)]
    command += ["--gcp", "none"]  # copr has a list among its photos
    begun = time.perf_counter()
    done = subprocess.run([*command], cwd=ROOT, capture_output=True, text=True, check=True)
    seconds = time.perf_counter() - begun
    facts = json.loads(
        subprocess.run([*command, "--json"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    )
    stages = {line.split()[0]: float(line.split()[-2]) for line in done.stdout.splitlines() if line.startswith(_STAGES)}
    adjust = facts["adjust"]
    return {
        "images": adjust["images"],
        "photos": adjust["photos"],
        "points": adjust["points"],
        "points_seen_thrice": adjust["points_seen_thrice"],
        "observations": adjust["observations"],
        "median_px": adjust["median_px"],
        "gnss_rms_m": adjust["gnss_rms_m"],
        "seconds": seconds,
        "seconds_by_stage": stages,
    }


def colmap(photos: Path, folder: Path, cores: int) -> dict[str, Any]:
    """Run COLMAP's incremental pipeline and return the figures of its largest model."""
    import pycolmap

    folder.mkdir()
    reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    matching, mapping = pycolmap.FeatureMatchingOptions(), pycolmap.IncrementalPipelineOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    for options in (extraction, matching, mapping):
        options.num_threads = cores
    database, seconds = folder / "database.db", {}
    names = sorted(p.name for p in photos.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".png", ".tif"))
    begun = time.perf_counter()
    pycolmap.extract_features(
        database,
        photos,
        image_names=names,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    seconds["features"] = time.perf_counter() - begun
    begun = time.perf_counter()
    pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
    seconds["match"] = time.perf_counter() - begun
    begun = time.perf_counter()
    models = pycolmap.incremental_mapping(database, photos, folder, options=mapping)
    seconds["mapping"] = time.perf_counter() - begun
    model = max(models.values(), key=lambda m: m.num_reg_images())
    lengths = np.array([point.track.length() for point in model.points3D.values()])
    errors = [
        np.linalg.norm(model.images[element.image_id].project_point(point.xyz) - _pixel(model, element))
        for point in model.points3D.values()
        for element in point.track.elements
    ]
    return {
        "images": model.num_reg_images(),
        "photos": len(names),
        "points": len(lengths),
        "points_seen_thrice": int((lengths >= 3).sum()),
        "observations": int(lengths.sum()),
        "median_px": float(np.median(errors)),
        "seconds_by_stage": seconds,
    }


def _pixel(model: Any, element: Any) -> np.ndarray:
    return model.images[element.image_id].points2D[element.point2D_idx].xy


_HEADER = """\
| set | side | images | points | seen 3 times or more | observations | median px | seconds | ratio | by stage (s) |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"""


def _line(name: str, side: str, result: dict[str, Any]) -> str:
    row = result[side]
    stages = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in row["seconds_by_stage"].items() if seconds >= 0.1)
    ratio = row["seconds"] / result["colmap"]["seconds"]
    cells = [
        name,
        side,
        f"{row['images']} of {row['photos']}",
        str(row["points"]),
        str(row["points_seen_thrice"]),
        str(row["observations"]),
        f"{row['median_px']:.3f}",
        f"{row['seconds']:.1f}",
        f"{ratio:.2f}",
        stages,
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
