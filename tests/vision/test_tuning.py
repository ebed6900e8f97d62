"""Thresholds by condition: measured, named or set."""

from dataclasses import fields

import numpy as np
import pytest
from PIL import Image

from jaxba.engine._fingerprint import fingerprint
from jaxba.pipeline import features
from jaxba.scene import Photo
from jaxba.vision import ImageStatistics, Tuning, tune

PLAIN = ImageStatistics(mean_brightness=120.0, flat_share=0.0, repeating_share=0.0)


def values(tuning: Tuning) -> dict[str, object]:
    names = ("nfeatures", "contrast_threshold", "edge_threshold", "fast_threshold", "nlevels")
    return {name: getattr(tuning, name) for name in names if getattr(tuning, name) is not None}


def test_base_values_are_the_detectors() -> None:
    assert values(tune("sift", (), PLAIN)) == {"nfeatures": 8000, "contrast_threshold": 0.04, "edge_threshold": 10.0}
    assert values(tune("orb", (), PLAIN)) == {"nfeatures": 10000, "fast_threshold": 20, "nlevels": 8}
    assert tune("sift", (), PLAIN).reasons == ()


@pytest.mark.parametrize(
    ("condition", "measured", "detector", "name", "value"),
    [
        ("low_light", ImageStatistics(mean_brightness=79.9, flat_share=0.0, repeating_share=0.0), "sift",
         "contrast_threshold", 0.03),
        ("rows", ImageStatistics(mean_brightness=120.0, flat_share=0.0, repeating_share=0.21), "sift",
         "edge_threshold", 15.0),
        ("water", ImageStatistics(mean_brightness=120.0, flat_share=0.31, repeating_share=0.0), "sift",
         "contrast_threshold", 0.03),
        ("water", ImageStatistics(mean_brightness=120.0, flat_share=0.31, repeating_share=0.0), "orb",
         "fast_threshold", 15),
        ("varying_height", None, "orb", "nlevels", 10),
    ],
)  # fmt: skip
def test_a_condition_changes_its_threshold_and_no_other(
    condition: str, measured: ImageStatistics | None, detector: str, name: str, value: float
) -> None:
    by_name = tune(detector, (condition,), None)
    assert values(by_name) == values(tune(detector, (), None)) | {name: value}
    assert by_name.conditions == (condition,) and f"{name} {value:g}" in by_name.reasons[0]
    if measured is not None:
        by_figure = tune(detector, (), measured)
        assert values(by_figure) == values(by_name) and by_figure.conditions == (condition,)
        assert any(text in by_figure.reasons[0] for text in ("over 20%", "over 30%", "80 of 255, under 80"))


def test_a_value_that_was_set_wins_and_is_said() -> None:
    tuning = tune("sift", ("rows", "low_light"), None, edge_threshold=8.0)
    assert tuning.edge_threshold == 8 and tuning.contrast_threshold == 0.03
    assert [reason.partition("): ")[2] for reason in tuning.reasons] == [
        "contrast_threshold 0.03",
        "edge_threshold stays as set, 8",
    ]


def test_a_condition_without_effect_says_so() -> None:
    assert tune("orb", ("rows",), None).reasons == ("rows (set by features.condition): changes nothing for ORB",)
    assert values(tune("akaze", ("rows", "water"), None)) == {"nfeatures": 8000}


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Photo:
    """A dark photo of stripes."""
    path = tmp_path_factory.mktemp("stripes") / "rows.png"
    x = np.arange(400)
    gray = 40 + 25 * np.sin(2 * np.pi * x / 16) + np.random.default_rng(0).normal(0, 6, (300, 400))
    Image.fromarray(np.clip(gray, 0, 255).astype(np.uint8)).convert("RGB").save(path)
    return Photo(name=path.name, path=path, sha256="", width_px=400, height_px=300, camera="a")


def run(photo: Photo, **params) -> features.Outputs:
    return features.run(features.Inputs(photo=photo), features.Params(**params))


def test_conditions_of_a_photo_are_measured_named_or_left_out(photo: Photo) -> None:
    measured = run(photo).tuning
    assert measured.conditions == ("low_light", "rows")
    assert measured.statistics is not None and measured.statistics.repeating_share > 0.9
    named = run(photo, condition="rows, low_light")
    assert values(named.tuning) == values(measured) and named.tuning.statistics is None
    none = run(photo, condition="none").tuning
    assert none.conditions == () and values(none) == values(tune("sift", (), None))
    more = run(photo, condition="auto,water", detector="orb").tuning
    assert more.conditions == ("low_light", "rows", "water") and more.fast_threshold == 15


def test_the_tuning_is_what_the_photo_was_looked_at_with(photo: Photo) -> None:
    by_figure, by_value = run(photo), run(photo, condition="none", edge_threshold=15.0)
    assert by_figure.tuning.edge_threshold == by_value.tuning.edge_threshold == 15
    base = run(photo, condition="none")
    assert by_figure.features.num_keypoints > base.features.num_keypoints
    for field in fields(by_figure.features):
        one, two = (getattr(made.features, field.name) for made in (by_figure, run(photo)))
        assert np.array_equal(one, two), field.name
    assert fingerprint(by_figure) == fingerprint(run(photo))


def test_the_blocks_detector_is_taken_where_none_is_set(photo: Photo) -> None:
    inputs = features.Inputs(photo=photo, detector="orb", is_height_varying=True)
    found = features.run(inputs, features.Params())
    assert found.features.detector == "orb" == found.tuning.detector and found.tuning.nlevels == 10
    assert "varying height (of the block): nlevels 10" in found.tuning.reasons
    assert features.run(inputs, features.Params(condition="none")).tuning.nlevels == 8
    assert features.run(inputs, features.Params(detector="sift")).features.detector == "sift"


@pytest.mark.parametrize("wta_k", [2, 3])
def test_orb_looks_as_its_parameters_say(photo: Photo, wta_k: int) -> None:
    found = run(photo, detector="orb", wta_k=wta_k, scale_factor=1.5, nlevels=5, orb_patch=41, orb_edge=41)
    assert found.features.descriptors.shape[1] == (32 if wta_k == 2 else 64)
    assert found.features.size_px.min() == 41 and found.features.size_px.max() <= 41 * 1.5**4 * 1.001
    assert found.features.xy_px.min() > 41
