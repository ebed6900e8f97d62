"""Memory of matching where the features of all photos would not fit: `python -m benchmarks.many_photos --photos 500`.

Writes the features of as many simulated 12-megapixel frames (8000 random SIFT descriptors each, some shared with the
neighbours so that pairs verify), then runs the match stage over them in workers as `jaxba run` does, and samples what
the process and its workers hold for themselves (memory-mapped files apart, which the system drops at will).
"""

import argparse
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import psutil

from jaxba.engine import Resources
from jaxba.engine._engines import work
from jaxba.engine._items import Item
from jaxba.engine._key import Key
from jaxba.engine._store import Stored, load, save
from jaxba.engine._work import run_one
from jaxba.pipeline import PIPELINE, features, match
from jaxba.scene import Features, Photo, Reference

WIDTH_PX, HEIGHT_PX, KEYPOINTS = 4000, 3000, 8000
PARTNERS = 4
_KEY = Key("", {}, {})


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.many_photos", description=__doc__)
    parser.add_argument("--photos", type=int, default=500)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        photos, stored = _write_features(folder, options.photos)
        size_mb = sum(path.stat().st_size for path in folder.rglob("*.npy")) / 1e6
        with _Peak() as peak:
            begun = time.perf_counter()
            items = [_item(folder, photos, stored, image) for image in range(options.photos - 1)]
            ended = work(run_one, items, Resources(workers=options.workers))
            failed = sum((reason or died) is not None for _, reason, died in ended)
            seconds = time.perf_counter() - begun
        inliers = np.median(load(folder / "match" / "0", match.Outputs).view_graph.num_inliers)
    print(
        f"{options.photos} photos, {size_mb:.0f} MB of features, {PARTNERS} partners each, {options.workers} workers: "
        f"{seconds:.0f} s, {failed} failed, median {inliers:.0f} verified matches in the first photo's pairs; "
        f"peak {peak.parent_mb:.0f} MB in the process, {peak.worker_mb:.0f} MB in the largest worker"
    )


def _write_features(folder: Path, count: int) -> tuple[tuple[Photo, ...], Stored]:
    rng = np.random.default_rng(0)
    photos, folders = [], {}
    xy_px = rng.uniform((0, 0), (WIDTH_PX, HEIGHT_PX), (KEYPOINTS, 2)).astype(np.float32)
    descriptors = rng.integers(0, 256, (KEYPOINTS, 128), dtype=np.uint8)
    for image in range(count):
        moved = (xy_px + np.array([60.0 * image, 0])) % (WIDTH_PX, HEIGHT_PX)
        fresh = rng.permutation(KEYPOINTS)[: KEYPOINTS // 10]
        descriptors[fresh] = rng.integers(0, 256, (len(fresh), 128), dtype=np.uint8)
        made = Features(
            detector="sift",
            xy_px=moved.astype(np.float32),
            size_px=np.full(KEYPOINTS, 5, np.float32),
            angle_rad=np.zeros(KEYPOINTS, np.float32),
            descriptors=descriptors,
            rgb=np.zeros((KEYPOINTS, 3), np.uint8),
            mean_brightness=100.0,
            coverage=1.0,
        )
        folders[image] = folder / "features" / str(image)
        save(folders[image], features.Outputs(features=made), _KEY)
        photos.append(
            Photo(
                name=f"{image:04d}.jpg",
                path=folder,
                sha256="",
                width_px=WIDTH_PX,
                height_px=HEIGHT_PX,
                camera="simulated",
                focal_px=3000.0,
            )
        )
    return tuple(photos), Stored(features.Outputs, "features", folders, dict.fromkeys(folders, ""))


def _item(folder: Path, photos: tuple[Photo, ...], stored: Stored, image: int) -> Item:
    partners = np.arange(image + 1, min(image + 1 + PARTNERS, len(photos)))
    unknown = np.full((len(photos), 3), np.nan)
    reference = Reference(
        frame=None,
        xyz_m=unknown,
        std_m=unknown,
        quaternion=np.full((len(photos), 4), np.nan),
        attitude_std_rad=unknown,
        is_used=np.zeros(len(photos), bool),
        height_above_ground_m=unknown[:, 0],
    )
    inputs = match.Inputs(
        image=image,
        partners=partners,
        overlap=np.full(len(partners), 0.8),
        photos=photos,
        reference=reference,
        features=stored.only([image, *partners]),
    )
    arguments = (match.__name__, folder / "match" / str(image), inputs, PIPELINE.settings["match"], _KEY)
    return Item(name=str(image), arguments=arguments, need_bytes=1e9)


class _Peak:
    """Samples, every 20 ms, the memory that only this process and its workers hold."""

    def __enter__(self) -> "_Peak":
        self.parent_mb = self.worker_mb = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._sample)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _sample(self) -> None:
        own = psutil.Process()
        while not self._stop.wait(0.02):
            self.parent_mb = max(self.parent_mb, own.memory_full_info().uss / 1e6)
            for child in own.children(recursive=True):
                try:
                    self.worker_mb = max(self.worker_mb, child.memory_full_info().uss / 1e6)
                except psutil.Error:
                    continue


if __name__ == "__main__":
    main()
