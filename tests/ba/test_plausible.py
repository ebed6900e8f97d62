"""Cameras that no lens can be are refused at the start, and named where the solver took them there."""

import dataclasses
import re
from typing import Any

import equinox as eqx
import numpy as np
import pytest
from small_problems import EVERY_CAMERA, small_problem

import jaxba
from jaxba._errors import JaxbaError
from jaxba.ba import Observations, Problem, prepare
from jaxba.ba.checks._plausible import implausible_cameras
from jaxba.geometry import BAL, AbstractCamera, OpenCV, OpenCVFisheye, Pose, Radial, SimplePinhole, SimpleRadial

FOCAL = [(camera, name) for camera in EVERY_CAMERA for name in camera.parameter_names() if name.startswith("f")]
BEYOND = "turns back .* of its pixels lie beyond"


def with_camera(problem: Problem, **values: float) -> Problem:
    for name, value in values.items():
        changed = np.array(getattr(problem.cameras, name))
        changed[-1] = value
        problem = eqx.tree_at(lambda p, name=name: getattr(p.cameras, name), problem, changed)
    return problem


@pytest.mark.parametrize("camera", EVERY_CAMERA, ids=lambda c: type(c).__name__)
def test_a_lens_of_every_model_is_plausible(camera: AbstractCamera):
    assert implausible_cameras(small_problem(camera, num_images=4, num_cameras=2), few=0.0) == []


@pytest.mark.parametrize("value", [-1000.0, -1e-300, 0.0, -0.0, 1e12])
@pytest.mark.parametrize(("camera", "name"), FOCAL, ids=lambda x: x if isinstance(x, str) else type(x).__name__)
def test_a_focal_length_that_is_none_is_refused(camera: AbstractCamera, name: str, value: float):
    problem = with_camera(small_problem(camera, num_images=4, num_cameras=2), **{name: value})
    said = re.escape(f"cameras: camera 1 has {name} = {value:g} px, ")
    with pytest.raises(JaxbaError, match=f"{said}.*; give the nominal"):
        prepare(problem)


@pytest.mark.parametrize("camera", [*EVERY_CAMERA[:5], BAL(800.0, 0.0, 0.0)], ids=lambda c: type(c).__name__)
def test_a_focal_length_in_millimetres_is_refused(camera: AbstractCamera):
    problem = with_camera(small_problem(camera), **{n: 8.8 for n in camera.parameter_names() if n.startswith("f")})
    with pytest.raises(JaxbaError, match=r"camera 0 \(f.* = 8.8.* has half of its pixels more than 8\d.\d degrees off"):
        prepare(problem)


@pytest.mark.parametrize(
    ("camera", "values", "message"),
    [
        (
            SimplePinhole(800.0, 500.0, 400.0),
            {"cx": 1e9},
            "degrees off its axis; give focal length and principal point",
        ),
        (
            OpenCVFisheye(800.0, 800.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0),
            {"fx": 10.0, "fy": 10.0},
            "degrees off its axis",
        ),
        (SimpleRadial(800.0, 500.0, 400.0, 0.0), {"k1": -50.0}, BEYOND),
        (Radial(800.0, 500.0, 400.0, 0.0, 0.0), {"k2": -500.0}, BEYOND),
        (Radial(800.0, 500.0, 400.0, 0.0, 0.0), {"k1": -1e29}, BEYOND),
        (OpenCV(800.0, 800.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0), {"k3": -1e4}, BEYOND),
        (OpenCV(800.0, 800.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0), {"p1": 10.0}, BEYOND),
        (OpenCV(800.0, 800.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0), {"k1": 1e6}, "stretches the image"),
        (OpenCVFisheye(800.0, 800.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0), {"k1": -50.0}, BEYOND),
        (BAL(800.0, 0.0, 0.0), {"k1": -50.0}, BEYOND),
    ],
)
def test_what_no_lens_can_be_is_refused(camera: AbstractCamera, values: dict[str, float], message: str):
    with pytest.raises(JaxbaError, match=f"cameras: camera 0 .*{message}"):
        prepare(with_camera(small_problem(camera), **values))


@pytest.mark.parametrize("k1", [-0.05, -0.2, -0.3, -1.0])
def test_a_distortion_turns_back_where_its_derivative_is_zero(k1: float):
    """One row of pixels along x, of all radii up to one focal length; without any beyond the turn nothing is said."""
    turn = 1 / np.sqrt(-3 * k1)
    largest = turn * (1 + k1 * turn**2)
    x = np.linspace(0.0, 1.0, 201)
    seen = Observations(np.column_stack([x, 0 * x]), np.ones(201), np.zeros(201, int), np.arange(201))
    problem = Problem.build(
        Pose(np.eye(4)[:1], np.zeros((1, 3))), SimpleRadial(1.0, 0.0, 0.0, k1), np.ones((201, 3)), seen
    )
    found = implausible_cameras(problem, few=0.0)
    if largest >= 1.0:
        assert found == []
    else:
        assert (
            f"turns back {largest:.3g} focal lengths" in found[0] and f"{np.mean(x > largest):.1%} of its" in found[0]
        )


@pytest.mark.parametrize(("values", "said"), [({"f": -800.0}, "f = -800 px"), ({"k1": -2.0}, "turns back"), ({}, "")])
def test_where_the_solver_took_a_camera_is_said(values: dict[str, float], said: str):
    problem = small_problem(EVERY_CAMERA[3])
    solution = jaxba.solve(problem, loss=jaxba.Huber(1.0), max_nfev=1)
    moved: Any = dataclasses.replace(solution, cameras=with_camera(solution.apply(problem), **values).cameras)
    assert said in moved.advice and ("Not to be used as it is: camera 0" in moved.advice) == bool(values)
    assert bool(moved.implausible_cameras) == bool(values)
