import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_survey import Survey

from jaxba import JaxbaError
from jaxba.pipeline import PIPELINE, _stages, features
from jaxba.report import recorded
from jaxba.scene import Photo, PhotoFile


def photo_of(path: Path, width_px: int, height_px: int) -> Photo:
    return Photo(name=path.name, path=path, sha256="", width_px=width_px, height_px=height_px, camera="a")


def test_real_frame_has_as_many_features_as_asked_for_all_over_it(data_dir: Path) -> None:
    path = sorted((data_dir / "images" / "brighton").glob("*.JPG"))[0]
    outputs = features.run(features.Inputs(photo=photo_of(path, 1600, 900)), features.Params(nfeatures=3000))
    found = outputs.features
    assert len(np.unique(found.xy_px, axis=0)) == 3000 and found.descriptors.shape == (found.num_keypoints, 128)
    assert found.coverage > 0.8
    assert np.all((found.xy_px > 0) & (found.xy_px < [1600, 900]))


def test_black_frame_has_zero_features(tmp_path: Path) -> None:
    path = tmp_path / "black.jpg"
    Image.new("RGB", (320, 240)).save(path)
    found = features.run(features.Inputs(photo=photo_of(path, 320, 240)), features.Params()).features
    assert found.num_keypoints == 0 and "no texture" in found.notes[0]


def test_a_frame_whose_statistics_fail_keeps_its_features_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(gray: np.ndarray) -> None:
        raise ValueError("zero-size array to reduction operation minimum which has no identity")

    path = tmp_path / "noise.jpg"
    Image.effect_noise((320, 240), 50).save(path)
    inputs = features.Inputs(photo=photo_of(path, 320, 240))
    plain = features.run(inputs, features.Params())
    monkeypatch.setattr(features, "measure_image", fail)
    found = features.run(inputs, features.Params())
    assert np.array_equal(found.features.xy_px, plain.features.xy_px) and found.tuning.statistics is None
    said = [note for note in found.features.notes if "light and texture could not be measured" in note]
    assert len(said) == 1 and "zero-size array" in said[0] and "the work goes on without it" in said[0]


def test_frame_of_another_size_than_its_tags_were_read_of_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "resized.jpg"
    Image.new("RGB", (320, 240)).save(path)
    with pytest.raises(JaxbaError, match=r"resized\.jpg has 320 x 240 pixels, and had 640 x 480 before"):
        features.run(features.Inputs(photo=photo_of(path, 640, 480)), features.Params())


def test_truncated_frame_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "cut.jpg"
    Image.effect_noise((320, 240), 50).save(path)
    path.write_bytes(path.read_bytes()[:8000])
    with pytest.raises(JaxbaError, match=r"cut\.jpg cannot be decoded"):
        features.run(features.Inputs(photo=photo_of(path, 320, 240)), features.Params())


@pytest.mark.parametrize("module", ["features", "match"])
def test_worker_that_imports_the_stage_loads_no_jax(module: str) -> None:
    code = f"import sys, jaxba.pipeline.{module}; print(sorted({{'jax', 'optimistix', 'pandas'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("detector", ["sift", "orb"])
@pytest.mark.parametrize("scale", [1, 2])
@pytest.mark.parametrize(
    ("mode", "suffix"),
    [("L", ".png"), ("RGB", ".jpg"), ("1", ".png"), ("P", ".png"), ("RGBA", ".png"), ("I;16", ".tif")],
)
def test_no_feature_is_taken_where_the_mask_is_black(
    tmp_path: Path, detector: str, mode: str, suffix: str, scale: int
) -> None:
    path = tmp_path / "noise.png"
    Image.effect_noise((320, 240), 90).save(path)
    values = np.full((240 * scale, 320 * scale), 255, np.uint8)
    values[:, : 160 * scale] = 0
    mask = Image.fromarray(values if mode != "I;16" else values.astype(np.uint16))
    mask = mask if mode == "I;16" else mask.convert(mode)
    mask.save(tmp_path / f"mask{suffix}")
    photo = photo_of(path, 320, 240)
    params = features.Params(detector=detector)
    whole = features.run(features.Inputs(photo=photo), params).features
    file = PhotoFile(name="mask", path=tmp_path / f"mask{suffix}", sha256="")
    found = features.run(features.Inputs(photo=replace(photo, mask=file)), params).features
    assert (whole.xy_px[:, 0] < 150).sum() > 50 < (found.xy_px[:, 0] > 170).sum()
    assert found.xy_px[:, 0].min() >= 159.4  # to the pixel, by its nearest centre
    assert "50% of the photo is masked" in found.notes


def test_a_mask_over_all_of_a_photo_is_named_as_the_reason(tmp_path: Path) -> None:
    Image.effect_noise((320, 240), 90).save(tmp_path / "noise.png")
    Image.new("L", (320, 240)).save(tmp_path / "mask.png")
    file = PhotoFile(name="mask.png", path=tmp_path / "mask.png", sha256="")
    photo = replace(photo_of(tmp_path / "noise.png", 320, 240), mask=file)
    found = features.run(features.Inputs(photo=photo), features.Params()).features
    assert found.num_keypoints == 0 and "100% of the photo is masked" in found.notes


def test_another_mask_reruns_its_own_photo_alone(made: Survey) -> None:
    done = recorded(made.project, PIPELINE).done
    first, *others = done.photos

    def identities(sha256: str | None) -> dict[str, object]:
        mask = None if sha256 is None else PhotoFile(name="m.png", path=Path("m.png"), sha256=sha256)
        photos = (replace(first, mask=mask), *others)
        items = _stages._features(replace(done, metadata=replace(done.metadata, photos=photos)))
        return {item.name: item.identity for item in items}

    without, black, other = identities(None), identities("a" * 64), identities("b" * 64)
    changed = {name for name in without if without[name] != black[name] or black[name] != other[name]}
    assert changed == {first.name} and len({str(of[first.name]) for of in (without, black, other)}) == 3
