"""Indices, masks, arrays and slices mean the same wherever entries of a kind are chosen; what is no choice is named."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxba._errors import JaxbaError
from jaxba.ba import Problem, free_gauge
from jaxba.simulation import uav_block

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
FIRST_AND_LAST = {
    "list": [0, 7],
    "tuple": (0, 7),
    "set": {0, 7},
    "range": range(0, 8, 7),
    "generator": "generator",
    "numpy": np.array([0, 7]),
    "int32": np.array([7, 0, 7], np.int32),
    "unsigned": np.array([0, 7], np.uint8),
    "jax": jnp.array([0, 7]),
    "list of numpy": [np.int64(0), np.array(7)],
    "objects": np.array([0, 7], object),
    "mask": np.isin(np.arange(8), [0, 7]),
    "list of bools": [i in (0, 7) for i in range(8)],
    "list of numpy bools": [np.bool_(i in (0, 7)) for i in range(8)],
    "jax mask": jnp.isin(jnp.arange(8), jnp.array([0, 7])),
    "slice": slice(0, None, 7),
}
ALL = {
    "True": True,
    "numpy True": np.True_,
    "array True": np.array(True),
    "slice": slice(None),
    "mask": np.ones(8, bool),
}
NONE = {
    "None": None, "False": False, "numpy False": np.False_, "empty list": [], "empty array": np.array([]),
    "empty int": np.zeros(0, int), "mask": np.zeros(8, bool), "empty slice": slice(0, 0), "jax": jnp.zeros(0, int),
}  # fmt: skip
WRONG = {
    "too high": ([3, 8, 9], r"poses: index 8 \(and 1 more\), but there are 8 images, counted from 0 to 7"),
    "below zero": ([-1], "poses: index -1, but there are 8 images"),
    "array below zero": (np.array([0, -3]), "poses: index -3, but there are 8"),
    "single": (8, "poses: index 8, but"),
    "short mask": (np.ones(7, bool), r"poses: a mask of shape \(7,\) for 8 images; give one True or False for each"),
    "flat empty mask": (np.zeros(0, bool), r"a mask of shape \(0,\) for 8"),
    "floats": (np.array([0.0, 1.0]), "of type float64 .* give indices of images as whole numbers"),
    "a float": (0.5, "poses: 0.5 of type float64"),
    "nan": (np.nan, "poses: nan of type float64"),
    "text": ("DJI_0001.JPG", "poses: 'DJI_0001.JPG' of type"),
    "texts": (["0", "7"], "of type <U1 .* give indices"),
    "bools among indices": ([True, 2], "of type object"),
    "table": (np.array([[0], [1]]), r"and shape \(2, 1\); give indices"),
    "ragged": ([[0, 1], [2]], "of type object"),
    "huge": ([2**70], "of type object"),
    "object": (object(), "of type object"),
}


@pytest.fixture(scope="module")
def block() -> Problem:
    return uav_block(8, gnss_std_m=None).problem


def fixed(mask: Any) -> list[int]:
    return np.flatnonzero(~np.asarray(mask)).tolist()


@pytest.mark.parametrize("form", FIRST_AND_LAST)
def test_indices_of_any_form_are_held(block: Problem, form: str):
    value = FIRST_AND_LAST[form]
    given = (i for i in (0, 7)) if form == "generator" else value
    assert fixed(block.fix(poses=given).free.poses) == [0, 7]
    if np.ndim(value) == 1 and np.size(value) < 8:
        assert fixed(block.fix(points=value).free.points) == [0, 7]
        assert fixed(block.fix(intrinsics=value).free.intrinsics[0]) == [0, 7, 8]  # k3 is held from the start


@pytest.mark.parametrize("form", ALL)
def test_all_of_a_kind_are_held(block: Problem, form: str):
    held = block.fix(poses=ALL[form])
    assert not held.free.poses.any() and held.free.points.all()
    if form != "mask":
        assert not block.fix(points=ALL[form], intrinsics=ALL[form]).free.intrinsics.any()


@pytest.mark.parametrize("form", NONE)
def test_none_of_a_kind_is_held(block: Problem, form: str):
    assert block.fix(poses=NONE[form]).free.poses.all()
    if form != "mask":
        held = block.fix(points=NONE[form], intrinsics=NONE[form]).free
        assert held.points.all() and fixed(held.intrinsics[0]) == [8]


@pytest.mark.parametrize("one", [0, np.int32(0), np.array(0), np.array([0]), jnp.array(0)], ids=str)
def test_one_fixed_pose_leaves_the_scale(block: Problem, one: Any):
    assert free_gauge(block.fix(poses=one)) == ("scale",)


@pytest.mark.parametrize("case", WRONG)
def test_what_is_no_choice_is_named(block: Problem, case: str):
    value, message = WRONG[case]
    with pytest.raises(JaxbaError, match=message):
        block.fix(poses=value)


@pytest.mark.parametrize(
    "names",
    [
        *("k1", ["k1"], ("k1", "k1"), np.array(["k1"]), np.str_("k1"), 4, np.isin(NAMES, "k1"), {"k1"}),
        *(np.array(["k1"], object), np.array([4], object), np.isin(NAMES, "k1").astype(object)),
    ],
    ids=repr,
)
def test_intrinsics_are_held_by_name_place_or_mask(block: Problem, names: Any):
    assert fixed(block.fix(intrinsics=names).free.intrinsics[0]) == [4, 8]


def test_intrinsics_are_held_camera_by_camera():
    two = uav_block(8, num_cameras=2).problem
    mask = np.zeros((2, 9), bool)
    mask[1, 0] = True
    for given in (mask, jnp.array(mask), mask.tolist()):
        assert fixed(two.fix(intrinsics=given).free.intrinsics) == fixed(two.free.intrinsics & ~mask)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (["k9"], r"fix: intrinsics: 'k9' is none of the intrinsics of a OpenCV camera: fx, fy"),
        ("f", "'f' is none of"),
        (9, "index 9, but there are 9"),
        (np.ones((3, 9), bool), r"a mask of shape \(3, 9\)"),
        (9, "but there are 9 intrinsics of a OpenCV camera, counted from 0"),
        (["k1", 2], "of type object"),
        ([["k1"], ["k1", "k2"]], "of type object"),
        (b"k1", "of type .S2"),
        (np.array(["k1", 2], object), "of type object"),
    ],
)
def test_an_unknown_intrinsic_is_named(block: Problem, value: Any, message: str):
    with pytest.raises(JaxbaError, match=message):
        block.fix(intrinsics=value)


def test_bounds_are_numbers_or_one_for_each_camera():
    two = uav_block(8, num_cameras=2).problem
    bounded = two.bound(k1=(np.array([-0.1, -0.2]), np.array(0.1)), focal=(np.float32(0.5), jnp.array([1.5, 2.0])))
    np.testing.assert_allclose(bounded.lower[:, 4], [-0.1, -0.2])
    np.testing.assert_allclose(bounded.upper[:, 0], np.array([1.5, 2.0]) * two.cameras.fx)


@pytest.mark.parametrize(
    ("pair", "message"),
    [
        ((0.1, -0.1), "bounds k1=0.1,-0.1: the lower bound must be below"),
        ((0.1, np.nan), "bounds k1=0.1,nan: the lower"),
        ((np.array([0.0, 1.0]), 2.0), "bounds k1=.*: give the lower and the upper one"),
        (0.1, "bounds k1=0.1: give the lower and the upper one"),
        ((1, 2, 3), "bounds k1=.*: give the lower and the upper one"),
        ("ab", "bounds k1=ab: give the lower and the upper one"),
    ],
)
def test_bounds_that_are_none_are_named(block: Problem, pair: Any, message: str):
    with pytest.raises(JaxbaError, match=message):
        block.bound(k1=pair)


@pytest.mark.parametrize("of", ["index", "entry", "mask"])
def test_a_traced_choice_is_named(block: Problem, of: str):
    def hold(traced: jax.Array) -> jax.Array:
        given: dict[str, Any] = {"index": {"poses": traced}, "entry": {"points": [traced]}}
        return jnp.asarray(block.fix(**given.get(of, {"intrinsics": jnp.ones((1, 9)) == traced})).free.poses)

    with pytest.raises(JaxbaError, match="are traced, as arguments of jit are; choose them outside"):
        jax.jit(hold)(0)


@pytest.mark.parametrize("kind", [list, np.array, lambda mask: np.array(mask, object)])
def test_a_list_of_lists_masks_the_intrinsics_of_each_camera(kind: Any):
    problem = uav_block(8, num_cameras=2).problem
    mask = [[name == "k1" for name in NAMES], [name == "p2" for name in NAMES]]
    free = problem.fix(intrinsics=kind(mask)).free.intrinsics
    assert (free == (problem.free.intrinsics & ~np.array(mask))).all()


def test_names_as_a_table_keeps_them_are_names():
    problem = uav_block(8).problem.fix(intrinsics=np.array(["k1", "p2"], object))
    assert [name for name, free in zip(NAMES, problem.free.intrinsics[0], strict=True) if not free] == [
        "k1",
        "p2",
        "k3",
    ]
