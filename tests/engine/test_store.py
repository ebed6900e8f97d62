import dataclasses
import json
import os

import numpy as np
import pytest
from jaxtyping import Float, Int

from jaxba import JaxbaError
from jaxba.engine._key import Key
from jaxba.engine._store import Stored, damage, load, read_record, save, save_failure
from jaxba.scene import Attitude, LeftOut, Photo, Position, ViewGraph

ONE, TWO = (Key(code, {"ratio": 0.1}, {"photo": "00"}) for code in ("one", "two"))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Made:
    points: Float[np.ndarray, "points 3"]
    index: Int[np.ndarray, " points"]
    photos: tuple[Photo, ...]
    graph: ViewGraph
    rms: tuple[float, float, float] | None
    left: tuple[LeftOut, ...] = ()


@pytest.fixture
def made(tmp_path):
    photo = Photo(
        name="a/b.jpg",
        path=tmp_path / "b.jpg",
        sha256="00",
        width_px=4,
        height_px=3,
        camera="c",
        position=Position(x=-93.123456789012345, y=44.9, z_m=None),
        attitude=Attitude(yaw_deg=1.0, pitch_deg=-90.0, roll_deg=0.1),
    )
    return Made(
        points=np.random.default_rng(0).normal(size=(5, 3)),
        index=np.arange(5, dtype=np.int32),
        photos=(photo,),
        graph=ViewGraph.empty(),
        rms=(0.1, 0.2, float("nan")),
    )


def test_what_was_saved_comes_back_bit_for_bit(tmp_path, made):
    save(tmp_path / "made", made, ONE)
    read = load(tmp_path / "made", Made)
    assert read.photos == made.photos
    assert read.points.tobytes() == made.points.tobytes() and read.index.dtype == np.int32
    assert read.graph.matches.shape == (0, 2)
    assert read.rms[:2] == (0.1, 0.2) and np.isnan(read.rms[2])


def test_arrays_are_mapped_and_the_file_is_safe_from_writes(tmp_path, made):
    save(tmp_path / "made", made, ONE)
    points = load(tmp_path / "made", Made).points
    assert isinstance(points, np.memmap)
    points[0, 0] = 7
    assert load(tmp_path / "made", Made).points.tobytes() == made.points.tobytes()


def test_record_tells_key_and_contents(tmp_path, made):
    first = save(tmp_path / "a", made, ONE)
    second = save(tmp_path / "b", made, TWO)
    moved = dataclasses.replace(made.photos[0], path=tmp_path / "elsewhere" / "b.jpg")
    third = save(tmp_path / "c", dataclasses.replace(made, photos=(moved,)), TWO)
    nudged = made.points.copy()
    nudged[4, 2] = np.nextafter(nudged[4, 2], np.inf)
    fourth = save(tmp_path / "d", dataclasses.replace(made, points=nudged), TWO)
    assert read_record(tmp_path / "a") == first and first.key == ONE
    assert first.digest == second.digest == third.digest != fourth.digest


def test_a_second_save_replaces_the_first_and_leaves_no_rest(tmp_path, made):
    save(tmp_path / "made", made, ONE)
    save(tmp_path / "made", dataclasses.replace(made, left=(LeftOut(name="x", reason="y"),)), TWO)
    assert load(tmp_path / "made", Made).left[0].reason == "y"
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


def test_an_error_while_writing_leaves_what_was_there(tmp_path, made, monkeypatch):
    save(tmp_path / "made", made, ONE)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(JaxbaError, match=r"made: not written, No space left on device: free some space"):
        save(tmp_path / "made", made, TWO)
    assert read_record(tmp_path / "made").key == ONE
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


def test_a_failure_is_kept_with_its_reason(tmp_path):
    save_failure(tmp_path / "made", "a.jpg is truncated", ONE)
    assert read_record(tmp_path / "made").failed == "a.jpg is truncated"


@pytest.mark.parametrize("content", ["", "{", json.dumps({"key": "one"})])
def test_a_damaged_record_counts_as_none(tmp_path, content):
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "record.json").write_text(content)
    assert read_record(tmp_path / "made") is None
    with pytest.raises(JaxbaError, match="missing or damaged; run again"):
        load(tmp_path / "made", Made)


def test_a_damaged_array_is_named(tmp_path, made):
    save(tmp_path / "made", made, ONE)
    (tmp_path / "made" / "points.npy").write_bytes(b"rubbish")
    with pytest.raises(JaxbaError, match=r"points\.npy: damaged"):
        load(tmp_path / "made", Made)


def flip(path, place):
    """Change one bit of a file."""
    content = bytearray(path.read_bytes())
    content[place] ^= 4
    path.write_bytes(content)


@pytest.mark.parametrize("place", [-1, 200, 3])
def test_one_wrong_bit_of_an_array_is_noticed(tmp_path, made, place):
    save(tmp_path / "made", made, ONE)
    assert damage(tmp_path / "made") is None
    flip(tmp_path / "made" / "points.npy", place % (tmp_path / "made" / "points.npy").stat().st_size)
    assert damage(tmp_path / "made") == "points.npy is damaged"
    os.remove(tmp_path / "made" / "points.npy")
    assert damage(tmp_path / "made") == "points.npy is missing"


def test_one_wrong_digit_of_a_record_is_noticed(tmp_path, made):
    save(tmp_path / "made", made, ONE)
    path = tmp_path / "made" / "record.json"
    path.write_text(path.read_text().replace("-93.12345", "-93.12346"))
    assert read_record(tmp_path / "made") is None and damage(tmp_path / "made") == "record.json is missing or damaged"


def test_a_stored_mapping_opens_what_is_looked_at(tmp_path, made):
    records = {i: save(tmp_path / str(i), made, ONE) for i in (2, 5)}
    stored = Stored(Made, "index", {i: tmp_path / str(i) for i in records}, {i: r.digest for i, r in records.items()})
    os.remove(tmp_path / "5" / "index.npy")
    assert sorted(stored) == [2, 5] and stored[2].tolist() == [0, 1, 2, 3, 4]
    only = stored.only([2])
    assert list(only) == [0] and only[0].tolist() == [0, 1, 2, 3, 4]
    with pytest.raises(JaxbaError, match=r"index\.npy"):
        _ = stored[5]


def test_a_record_of_another_version_is_said(made, tmp_path):
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Newer:
        points: Float[np.ndarray, "points 3"]
        since: int

    save(tmp_path / "made", made, ONE)
    with pytest.raises(JaxbaError, match=r"made: the record is of another version of jaxba; run again"):
        load(tmp_path / "made", Newer)
