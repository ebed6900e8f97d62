"""Inputs that are damaged at random: whatever reads them raises `JaxbaError` or returns something.

`python tests/test_mutated_inputs.py 5000` damages each input as often, and prints what else escapes.
"""

import collections
import io
import re
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from jaxba._errors import JaxbaError
from jaxba.engine import from_toml, to_toml
from jaxba.engine._project import Given, read_lists
from jaxba.io import (
    CrsText,
    parse_control,
    parse_geotags,
    read_bal,
    read_colmap_binary,
    read_colmap_text,
    read_problem,
    read_reconstruction,
    read_tile,
    write_colmap_binary,
    write_csv_cloud,
    write_ply,
    write_tile,
)
from jaxba.io._cloud import Cloud
from jaxba.io._read_cloud import read_csv_cloud, read_ply
from jaxba.pipeline import PIPELINE

NUMBER = re.compile(rb"-?\d+\.?\d*")
WORDS = (
    b"nan", b"inf", b"-1", b"0", b"1e308", b"-1e-320", b"99999999999999999999", b"", b"1.5", b"x", b"\xff\xfe",
    b"\xef\xbb\xbf", b"\x00", b"\t", b'"', b"'", b",", b";", b"#", b"\n", b"EPSG:", b"[", b"{", b"=", b"\xc3",
    b"\xe2\x80\xa8",
)  # fmt: skip

BAL = b"1 1 1  0 0 3 -4  0.1 0 0  0 0 0  100 0 0  0 0 -10\n"
COLMAP = {
    "cameras": b"1 PINHOLE 100 80 90 90 50 40\n2 PINHOLE 100 80 90 90 50 40\n",
    "images": b"1 1 0 0 0 0 0 5 1 a.jpg\n10 20 7 11 21 8\n2 0.6 0 0 0.8 -1 0 10 2 b.jpg\n12 22 7 13 23 8\n",
    "points3D": b"7 1 2 3 255 0 9 0.5 1 0 2 0\n8 2 2 3 255 0 9 0.5 1 1 2 1\n",
    "rigs": b"1 2 CAMERA 1 CAMERA 2 1 0.6 0 0 0.8 -1 0 5\n",
    "frames": b"1 1 1 0 0 0 0 0 5 2 CAMERA 1 1 CAMERA 2 2\n",
}
OPENSFM = (
    b'[{"cameras": {"c": {"projection_type": "brown", "width": 100, "height": 80, "focal_x": 0.9, "focal_y": 0.9}},'
    b'"shots": {"a.jpg": {"rotation": [0, 0, 0], "translation": [0, 0, 5], "camera": "c"}},'
    b'"points": {"7": {"color": [1, 2, 3], "coordinates": [1, 2, 3]}}}]'
)
TRACKS = b"OPENSFM_TRACKS_VERSION_v2\na.jpg\t7\t1\t0.1\t0.2\t0.01\t1\t2\t3\t-1\t-1\n"
GCP = (
    b"EPSG:32615\n576308.6 5183424.7 198.2 12 9 a.jpg g1\n576308.6 5183424.7 198.2 3 9 b (2).jpg g1 x\n",
    b"# EPSG:32615\nname,x,y,z,px,py,image,std_h,std_v,role\ng1,576308.6,5183424.7,,12,9,a.jpg,0.01,0.02,check\n",
)
GEO = (
    b"EPSG:4326\na.jpg -91.99 46.84 198.6 12.5 0 0 0.02 0.04 x\nb c.jpg\t-91.98\t46.84\tNaN\n",
    b"# CoordinateSystem: EPSG:4326\n#Label,X/Longitude,Y/Latitude,Z/Altitude,Accuracy\na.jpg,-91.99,46.84,198.6,0.3\n",
    b"name;lat;lon;alt;crs\na.jpg;46.84;-91.99;198.6;4326\n",
)


UTM = CrsText(text="EPSG:32615", name="UTM", unit="metre", height_unit="metre", height_note="Metres.")
CLOUDS = (
    ("cloud.ply", write_ply, read_ply),
    ("cloud.csv", write_csv_cloud, read_csv_cloud),
)


def damaged(rng: np.random.Generator, data: bytes) -> bytes:
    """Return bytes with one to three changes: numbers, words, pieces and lines replaced, dropped, doubled, moved."""
    for _ in range(rng.integers(1, 4)):
        kind, numbers = rng.integers(8), list(NUMBER.finditer(data))
        first, last = sorted(rng.integers(0, len(data) + 1, 2))
        word = WORDS[rng.integers(len(WORDS))]
        if kind < 3 and numbers:
            found = numbers[rng.integers(len(numbers))]
            data = data[: found.start()] + word + data[found.end() :]
        elif kind == 3:
            data = data[:first] + word + data[first:]
        elif kind == 4:
            data = data[:first] + data[min(last, first + 9) :]
        elif kind == 5:
            data = data[:first] + data[first:last] * 2 + data[last:]
        elif kind == 6:
            data = data[:first] + rng.bytes(int(rng.integers(1, 4))) + data[first + 1 :]
        else:
            lines = data.split(b"\n")
            rng.shuffle(lines)
            data = b"\n".join(lines) if rng.random() < 0.5 else data[:first]
    return data


def tile(rng: np.random.Generator, folder: Path) -> None:
    """Read a tile of which an array, or the file, is damaged."""
    write_tile(folder / "whole.npz", read_bal(written(folder / "bal.txt", BAL)))
    with np.load(folder / "whole.npz") as file:
        arrays = dict(file)
    name = list(arrays)[rng.integers(len(arrays))]
    array, kind = arrays[name], rng.integers(8)
    if kind == 0:
        del arrays[name]
    elif kind == 1:
        arrays[name[::-1]] = array
    elif kind == 2:
        arrays[name] = array.reshape(-1)[: rng.integers(0, 4)]
    elif kind == 3:
        kinds = ["S5", "O"] if array.dtype.kind == "U" else ["f4", "u8", "U5", "?", "c16", "O"]
        with np.errstate(invalid="ignore"):
            arrays[name] = array.astype(kinds[rng.integers(len(kinds))])
    elif kind == 4:
        arrays[name] = np.repeat(np.atleast_1d(array), 2, axis=0)
    elif kind == 5 and array.dtype.kind in "fi" and array.size:
        changed = array.astype(float).reshape(-1)
        changed[rng.integers(changed.size)] = [np.nan, np.inf, 0, -1, 1e308][rng.integers(5)]
        arrays[name] = changed.reshape(array.shape)
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    data = stream.getvalue()
    read_tile(written(folder / "tile.npz", damaged(rng, data) if kind > 5 else data))


def noise(rng: np.random.Generator, folder: Path) -> None:
    """Read bytes that are nothing, or begin as something."""
    begin = (
        b"",
        b"PK\x03\x04",
        b"BZh9",
        b"\x93NUMPY",
        b"ply\nformat binary_little_endian 1.0\n",
        b"\xff\xfe",
        b"1 1 1 ",
    )
    data = begin[rng.integers(len(begin))] + rng.bytes(int(rng.integers(0, 200)))
    read_problem(written(folder / "noise", data))


def bal(rng: np.random.Generator, folder: Path) -> None:
    read_bal(written(folder / "bal.txt", damaged(rng, BAL)))


def colmap(rng: np.random.Generator, folder: Path) -> None:
    chosen = list(COLMAP)[rng.integers(len(COLMAP))]
    for name, data in COLMAP.items():
        written(folder / f"{name}.txt", damaged(rng, data) if name == chosen else data)
    read_colmap_text(folder)


def colmap_binary(rng: np.random.Generator, folder: Path) -> None:
    for name in ("rigs", "frames"):
        (folder / f"{name}.txt").unlink(missing_ok=True)
    for name in ("cameras", "images", "points3D"):
        written(folder / f"{name}.txt", COLMAP[name])
    model = read_colmap_text(folder)
    write_colmap_binary(folder, model.block, model.names, model.size_px, model.error_px)
    chosen = folder / f"{('cameras', 'images', 'points3D')[rng.integers(3)]}.bin"
    data = bytearray(chosen.read_bytes())
    for _ in range(rng.integers(1, 4)):
        data[rng.integers(len(data))] = rng.integers(256)
    written(chosen, bytes(data[: rng.integers(len(data))] if rng.random() < 0.3 else data))
    read_colmap_binary(folder)


def opensfm(rng: np.random.Generator, folder: Path) -> None:
    written(folder / "reconstruction.json", damaged(rng, OPENSFM) if rng.random() < 0.7 else OPENSFM)
    written(folder / "tracks.csv", damaged(rng, TRACKS))
    read_reconstruction(folder / "reconstruction.json")


def control(rng: np.random.Generator, folder: Path) -> None:
    given = Given(photos=folder, gcp=written(folder / "gcp.txt", damaged(rng, GCP[rng.integers(len(GCP))])))
    parse_control(read_lists(given)["gcp"][1], is_photo="b (2).jpg".__eq__)


def geotags(rng: np.random.Generator, folder: Path) -> None:
    given = Given(photos=folder, geotags=written(folder / "geo.csv", damaged(rng, GEO[rng.integers(len(GEO))])))
    parse_geotags(read_lists(given)["geotags"][1], is_photo="b c.jpg".__eq__)


def toml(rng: np.random.Generator, folder: Path) -> None:
    lines = to_toml(PIPELINE.settings).encode().split(b"\n")
    begin = rng.integers(len(lines))
    data = b"[match]\n" + b"\n".join(lines[begin : begin + 8])
    from_toml(written(folder / "jaxba.toml", damaged(rng, data)), PIPELINE.settings)


def cloud(rng: np.random.Generator, folder: Path) -> None:
    """Read a cloud as PLY or CSV."""
    one = np.ones(2, int)
    made = Cloud(
        xyz=np.ones((2, 3)), rgb=np.zeros((2, 3), np.uint8), point_id=one, track_length=one, error_px=np.ones(2),
        std_m=np.full((2, 3), np.nan),
    )  # fmt: skip
    name, write, read = CLOUDS[rng.integers(len(CLOUDS))]
    write(folder / name, made, UTM)
    read(written(folder / name, damaged(rng, (folder / name).read_bytes())))


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


READERS: list[Callable[[np.random.Generator, Path], None]] = [
    tile, noise, bal, colmap, colmap_binary, opensfm, control, geotags, toml, cloud,
]  # fmt: skip


@pytest.mark.parametrize("read", READERS, ids=lambda read: read.__name__)
def test_a_damaged_input_is_read_or_refused_as_such(read: Callable[[np.random.Generator, Path], None], tmp_path: Path):
    refused = 0
    for seed in range(40):
        try:
            read(np.random.default_rng(seed), tmp_path)
        except JaxbaError as error:
            refused += 1
            assert len(str(error)) < 2000, seed
        except Exception as error:
            raise AssertionError(f"{read.__name__} with seed {seed} let {error!r} through") from error
    assert refused > 5  # the damage is real


if __name__ == "__main__":
    import tempfile

    for read in READERS:
        escaped: dict[str, list[int]] = collections.defaultdict(list)
        with tempfile.TemporaryDirectory() as folder:
            for seed in range(int(sys.argv[1])):
                try:
                    read(np.random.default_rng(seed), Path(folder))
                except JaxbaError:
                    continue
                except BaseException as error:
                    where = traceback.extract_tb(error.__traceback__)[-1]
                    escaped[f"{type(error).__name__}: {str(error)[:80]} ({where.filename}:{where.lineno})"].append(seed)
        print(read.__name__, "escaped:" if escaped else "nothing escaped")
        for what, seeds in escaped.items():
            print("  ", len(seeds), what, seeds[:5])
