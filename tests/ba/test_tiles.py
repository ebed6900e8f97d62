"""Tiles: the tree, the fronts, and steps tile by tile against those of the block in one piece."""

import dataclasses
import errno
import functools
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_problems import two_flights

import jaxba
from jaxba import JaxbaError, Problem, Solution
from jaxba.ba import AbstractPrior, IntrinsicsPrior, JacobianBlock, Rows, Unknowns
from jaxba.ba.tiles import _shelf
from jaxba.ba.tiles._budget import Budget
from jaxba.ba.tiles._dissect import Tree, dissect
from jaxba.ba.tiles._engine import Engine
from jaxba.ba.tiles._fronts import Fronts
from jaxba.ba.tiles._programs import Handed
from jaxba.geometry import AbstractLoss, Cauchy, Huber, Linear

_BLOCK = functools.partial(jaxba.synthetic.uav_block, 60, side_overlap=0.7, points_per_image=40.0, num_control=4)


@functools.cache
def everything() -> Problem:
    """One shared camera, GNSS under a robust loss with bad fixes, control, a free lever arm, an active bound."""
    survey = _BLOCK(
        outlier_fraction=0.03,
        lever_arm_m=(0.1, 0.2, 0.1),
        lever_arm_std_m=0.05,
        gnss_outlier_fraction=0.05,
        position_offset_m=(0.5, -0.4, 0.3),
        position_offset_std_m=1.0,
    )
    problem = two_flights(survey.problem).bound(k1=(-0.03, 0.03))
    priors = [dataclasses.replace(p, loss=Cauchy(3.0)) if p.name == "position" else p for p in problem.priors]
    return eqx.tree_at(lambda p: p.priors, problem, tuple(priors))


@functools.cache
def _fixed() -> Problem:
    """Three cameras; poses, points and an intrinsic held fixed; an image that sees nothing."""
    problem = _BLOCK(num_cameras=3).problem.fix(poses=[0, 7, 33], points=[5, 9, 200], intrinsics=["p1"])
    kept = problem.observations.image_index != 12
    return eqx.tree_at(lambda p: p.observations, problem, jax.tree.map(lambda of: of[kept], problem.observations))


@functools.cache
def with_own_cameras() -> Problem:
    """A camera for every image, some of them calibrated."""
    problem = _BLOCK(num_cameras=60).problem.fix(intrinsics=["k1", "k2", "p1", "p2", "cx", "cy"])
    calibrated = np.arange(3, 60, 4)
    parameters = np.stack([getattr(problem.cameras, name) for name in problem.cameras.parameter_names()], axis=1)
    parameters, std = parameters[calibrated] + calibrated[:, None], np.full((len(calibrated), 9), 2.0)
    prior = IntrinsicsPrior(camera_index=calibrated, parameters=parameters, std=std)
    return eqx.tree_at(lambda p: p.priors, problem, (*problem.priors, prior))


@functools.cache
def _whole(kind: str, max_nfev: int) -> Solution:
    return jaxba.solve(_KINDS[kind][0](), loss=_KINDS[kind][1], max_nfev=max_nfev, **_TIGHT)


_TIGHT = {"ftol": 1e-12, "xtol": 1e-12}
_KINDS: dict[str, tuple[Callable[[], Problem], AbstractLoss]] = {
    "everything": (everything, Huber(1.0)),
    "fixed": (_fixed, Linear()),
    "own cameras": (with_own_cameras, Linear()),
}


def _tree(problem: Problem, num_tiles: int) -> Tree:
    return dissect(problem, block=6, border=8, max_observations=1e9, num_tiles=num_tiles)


@pytest.mark.parametrize("num_tiles", [1, 2, 4, 9])
def test_the_images_of_a_point_stand_on_one_way_to_the_root(num_tiles: int) -> None:
    # breaks where an image is eliminated below a node that still sees it, or a boundary misses one
    problem = everything()
    tree = _tree(problem, num_tiles)
    assert len(tree.tiles) == num_tiles
    seen = problem.observations
    assert np.array_equal(np.sort(np.concatenate([node.eliminated for node in tree.nodes])), np.arange(60))
    inside: dict[int, set[int]] = {}
    for number, node in enumerate(tree.nodes):
        below = set(node.eliminated.tolist()).union(*(inside[child] for child in node.children))
        inside[number] = below
        assert not below & set(node.boundary.tolist())
        assert np.all(np.diff(tree.rank[np.concatenate([node.eliminated, node.boundary])]) > 0)
        if node.children:
            handed_on = set().union(*(tree.nodes[child].boundary.tolist() for child in node.children))
            assert handed_on == set(node.eliminated.tolist()) | set(node.boundary.tolist())
    for tile, number in enumerate(tree.tiles):
        of_tile = tree.tile_of_point[seen.point_index] == tile
        front = inside[number] | set(tree.nodes[number].boundary.tolist())
        assert set(np.asarray(seen.image_index)[of_tile].tolist()) == front
        whole = set(range(60)) - set(np.asarray(seen.image_index)[~of_tile].tolist())
        assert inside[number] == whole  # all images that no other tile sees, and no more
    sizes = np.bincount(tree.tile_of_point[seen.point_index])
    assert sizes.max() < 1.6 * sizes.mean()


def test_a_tile_has_no_more_observations_than_allowed() -> None:
    # breaks where the share of observations of a cut is taken for its share of tiles without looking again
    problem = everything()
    tree = dissect(problem, block=6, border=8, max_observations=1e3)
    assert np.bincount(tree.tile_of_point[problem.observations.point_index]).max() <= 1000
    again = dissect(problem, block=6, border=8, max_observations=1e3)
    jax.tree.map(np.testing.assert_array_equal, dataclasses.asdict(tree), dataclasses.asdict(again))


def test_cameras_in_one_place_are_cut_by_the_order_of_points() -> None:
    # breaks where a cut needs that places differ
    problem = everything()
    turned = eqx.tree_at(lambda p: p.poses.translation, problem, np.zeros((60, 3)))
    assert len(_tree(turned, 3).tiles) == 3


@pytest.mark.parametrize("num_tiles", [1, 4])
def test_fronts_solve_what_numpy_solves(num_tiles: int) -> None:
    # breaks where a block lands in the wrong place, a child is added twice, or damping enters twice
    rng = np.random.default_rng(0)
    problem = everything()
    tree = dissect(problem, block=6, border=3, max_observations=1e9, num_tiles=num_tiles)
    fronts = Fronts(tree, 6, 3)
    matrix, rhs = np.zeros((363, 363)), np.zeros(363)
    diagonal = 100 + rng.random((60, 6))
    updates: dict[int, np.ndarray] = {}
    factors = {}
    for tile, last in enumerate(tree.tiles):
        images = np.unique(
            np.asarray(problem.observations.image_index)[tree.tile_of_point[problem.observations.point_index] == tile]
        )
        images = images[np.argsort(tree.rank[images])]
        couples = np.abs(rng.normal(size=(len(images),) * 2)) < 1.0
        row, column = np.nonzero(np.tril(couples, -1))
        row, column = _that_stay_inside(tree, images, row, column)
        part = rng.normal(size=(len(images) * 6 + 3,) * 2)
        part += part.T
        blocks = part[:-3, :-3].reshape(len(images), 6, len(images), 6)
        tail = np.zeros((len(images), fronts.tail * 6, 6))
        tail[:, :3] = part[-3:, :-3].reshape(3, -1, 6).swapaxes(0, 1)
        of_rhs = rng.normal(size=len(images) * 6 + 3)
        tail[:, 3] = of_rhs[:-3].reshape(-1, 6)
        corner = np.zeros((fronts.tail * 6,) * 2)
        corner[:3, :3], corner[3, :3] = part[-3:, -3:], of_rhs[-3:]
        every = np.arange(len(images))
        handed = Handed(blocks[every, :, every], blocks[row, :, column], tail, corner, *[None] * 3)  # ty: ignore
        dense = np.zeros_like(blocks)
        dense[every, :, every], dense[row, :, column] = blocks[every, :, every], blocks[row, :, column]
        dense[column, :, row] = blocks[row, :, column].swapaxes(1, 2)
        whole = part.copy()
        whole[:-3, :-3] = dense.reshape(len(part) - 3, -1)
        place = np.append((images[:, None] * 6 + np.arange(6)).ravel(), [360, 361, 362])
        matrix[np.ix_(place, place)] += whole
        rhs[place] += of_rhs
        layout = fronts.tile_fronts(tile, images, row, column)
        for number, own in zip(range(layout.first, layout.last + 1), layout.parts, strict=True):
            children = [updates.pop(child) for child in tree.nodes[number].children]
            factors[number], updates[number] = fronts.eliminate(
                number, children, diagonal[tree.nodes[number].eliminated], own, handed
            )
        assert last == layout.last
    for number in range(len(tree.nodes)):
        if number not in factors:
            children = [updates.pop(child) for child in tree.nodes[number].children]
            of_own = diagonal[tree.nodes[number].eliminated]
            factors[number], updates[number] = fronts.eliminate(number, children, of_own)
    (top,) = updates.values()
    corner = np.tril(top[:3, :3]) + np.tril(top[:3, :3], -1).T + 200 * np.eye(3)
    matrix += np.diag(np.append(diagonal.ravel(), [200, 200, 200]))
    expected = np.linalg.solve(matrix, rhs)
    border = np.linalg.solve(corner, top[3, :3])
    np.testing.assert_allclose(border, expected[-3:], rtol=1e-9)
    solution, tail = np.zeros((60, 6)), np.zeros(fronts.tail * 6)
    tail[:3], tail[3] = border, -1
    for number in reversed(range(len(tree.nodes))):
        fronts.put_back(number, factors[number], solution, tail)
    np.testing.assert_allclose(solution.ravel(), expected[:-3], rtol=1e-9, atol=1e-12)


def _that_stay_inside(
    tree: Tree, images: np.ndarray, row: np.ndarray, column: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Keep the couples of images that stand in one front, as those that see a point together do."""
    fronts = [set(node.eliminated.tolist()) | set(node.boundary.tolist()) for node in tree.nodes]
    kept = [
        int(images[r]) in fronts[tree.node_of_image[images[c]]] or tree.node_of_image[images[c]] > max(tree.tiles)
        for r, c in zip(row, column, strict=True)
    ]
    return row[kept], column[kept]


@pytest.mark.parametrize(
    ("kind", "num_tiles"),
    [("everything", 2), ("everything", 4), ("everything", 9), ("fixed", 4), ("own cameras", 4)],
)
def test_steps_and_solution_are_those_of_the_block_in_one_piece(kind: str, num_tiles: int) -> None:
    # breaks where damping, a prior or a one of a fixed unknown enters twice or not at all, bounds are left, or tiles
    # judge a step by themselves
    problem, loss = _KINDS[kind][0](), _KINDS[kind][1]
    for max_nfev, cost_error, pose_error in ((1, 1e-9, 1e-9), (60, 1e-9, 1e-7)):
        whole = _whole(kind, max_nfev)
        tiled = jaxba.solve_tiled(problem, loss=loss, num_tiles=num_tiles, max_nfev=max_nfev, **_TIGHT)
        assert tiled.num_steps == whole.num_steps
        np.testing.assert_allclose(tiled.final_cost, whole.final_cost, rtol=cost_error)
        np.testing.assert_allclose(tiled.plain_cost, whole.plain_cost, rtol=1e-6)
        np.testing.assert_allclose(tiled.poses.translation, whole.poses.translation, rtol=0, atol=pose_error)
        np.testing.assert_allclose(tiled.poses.quaternion, whole.poses.quaternion, rtol=0, atol=pose_error)
        for name in whole.cameras.parameter_names():
            np.testing.assert_allclose(getattr(tiled.cameras, name), getattr(whole.cameras, name), rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(tiled.lever_arm, whole.lever_arm, rtol=0, atol=1e-7)
        np.testing.assert_allclose(tiled.position_offset, whole.position_offset, rtol=0, atol=1e-7)
    if kind == "everything":
        assert tiled.cameras.k1 == -0.03  # the bound is active


def test_solve_takes_the_tree_for_large_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    # breaks where solve leaves out the loss, the stops or the callback on its way there, or goes there against options
    problem, loss, costs = _KINDS["everything"][0](), _KINDS["everything"][1], []
    monkeypatch.setattr("jaxba.ba._solve._TILES_FROM", 60)
    solution = jaxba.solve(problem, loss=loss, max_nfev=2, callback=lambda step: costs.append(step.cost))
    monkeypatch.undo()
    assert solution.report is not None and solution.report.linear_solver == "tiles"
    once = jaxba.solve(problem, loss=loss, max_nfev=2)
    assert once.report is not None and once.report.linear_solver == "dense"
    np.testing.assert_allclose(costs, [step.cost for step in once.report.history[1:]], rtol=1e-9)


class _Level(AbstractPrior):
    """Cameras of some images stand at a height, with no field for a sigma."""

    name: ClassVar[str] = "level"
    image_index: np.ndarray | jax.Array
    loss: AbstractLoss = Linear()

    def residual(self, unknowns: Unknowns) -> jax.Array:
        return unknowns.poses.translation[self.image_index].T / 100

    def rows(self, unknowns: Unknowns) -> Rows:
        along = jnp.zeros((3, 6, len(self.image_index))).at[jnp.arange(3), jnp.arange(3, 6)].set(0.01)
        return Rows(residual=self.residual(unknowns), pose=JacobianBlock(self.image_index, along))


def test_a_prior_without_sigmas_counts_its_own_rows_alone() -> None:
    # breaks where it is filled up to a round number with copies of a row, in one piece or in tiles
    plain = _fixed()
    problem = eqx.tree_at(lambda p: p.priors, plain, (*plain.priors, _Level(np.arange(33))))
    whole = jaxba.solve(problem, **_TIGHT)
    of_level = np.sum(problem.poses.translation[:33] ** 2) / 100**2 / 2
    np.testing.assert_allclose(whole.initial_cost, jaxba.solve(plain, max_nfev=1).initial_cost + of_level, rtol=1e-12)
    tiled = jaxba.solve_tiled(problem, num_tiles=2, **_TIGHT)
    np.testing.assert_allclose(tiled.final_cost, whole.final_cost, rtol=1e-9)


def test_files_and_workers_do_not_change_a_byte() -> None:
    # breaks where sums are taken in the order in which threads end, or equations computed again differ
    problem, loss = _KINDS["everything"][0](), _KINDS["everything"][1]
    options = {"loss": loss, "num_tiles": 4, "max_nfev": 3}
    once = jaxba.solve_tiled(problem, **options, workers=1)
    again = jaxba.solve_tiled(problem, **options, workers=3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxba.ba.tiles._opened.plan_memory", lambda *_: Budget(0.0, 0.0, 0.0))
        in_files = jaxba.solve_tiled(problem, **options, workers=2)
    for other in (again, in_files):
        values, others = (jax.tree.leaves(dataclasses.replace(solution, report=None)) for solution in (once, other))
        for value, same in zip(values, others, strict=True):
            np.testing.assert_array_equal(value, same)
        assert [step.cost for step in once.report.history] == [step.cost for step in other.report.history]


def test_a_full_disk_names_the_folder_and_the_cure(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("jaxba.ba.tiles._opened.plan_memory", lambda *_: Budget(0.0, 0.0, 0.0))
    monkeypatch.setattr(_shelf.np, "save", full)
    with pytest.raises(JaxbaError, match=f"{tmp_path}.*No space left on device.*free there.*max_memory"):
        jaxba.solve_tiled(everything(), num_tiles=4, folder=str(tmp_path))


def test_a_lost_file_of_a_tile_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxba.ba.tiles._opened.plan_memory", lambda *_: Budget(0.0, 0.0, 0.0))

    def remove(_: object) -> None:
        for file in tmp_path.glob("jaxba-*/system-2-*.npy"):
            file.unlink()

    with pytest.raises(JaxbaError, match=r"jaxba-.*is gone or damaged .*system-2-.*Give a folder of your own"):
        jaxba.solve_tiled(everything(), loss=Huber(1.0), num_tiles=4, folder=tmp_path, max_nfev=3, callback=remove)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_memory": "lots"}, "max_memory 'lots': give an amount from 100MB such as 4GB"),
        (
            {"max_memory": "100MB"},
            "are needed: .* for the problem with .* points .* 100.0 MB are allowed; give more max_memory",
        ),
        ({"num_tiles": 0}, "num_tiles is 0; give a whole number, 1 or more"),
        ({"max_observations": 0.5}, "max_observations is 0.5; give a number"),
        ({"workers": 0}, "workers is 0; give a whole number"),
        ({"max_nfev": 0}, "solve_tiled: max_nfev is 0"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(JaxbaError, match=message):
        jaxba.solve_tiled(everything(), **options)


def _number_of(theta: tuple[Problem, AbstractLoss], **options: object) -> jax.Array:
    """Return a number that every kind of unknown and the cost have part in."""
    solution = jaxba.solve_tiled(theta[0], loss=theta[1], num_tiles=4, **options)
    rng = np.random.default_rng(1)
    parts = solution.points, solution.poses.translation, solution.cameras.fx, solution.lever_arm
    return 3 * solution.final_cost + sum(jnp.sum(rng.normal(size=np.shape(part)) * part) for part in parts)


_THETA = {  # and steps, of their size: longer ones of pixels cross the bend of the loss
    "pixels": (lambda t: t[0].observations.xy_px, 1e-8),
    "sigmas of positions": (lambda t: t[0].priors[0].std_m, 1e-3),
    "active bound": (lambda t: t[0].lower, 3e-4),
    "loss scale": (lambda t: t[1].f_scale, 1e-5),
}


def test_the_gradient_is_that_of_central_differences() -> None:
    # breaks where a tile's part is left out or counts twice, or what a bound holds moves
    with jax.enable_x64(True):
        problem = _whole("everything", 60).apply(jaxba.ba.prepare(everything()).problem)  # a few steps from each end
        theta = problem, Huber(jnp.array(1.0))
        numbers, rest = eqx.partition(theta, eqx.is_inexact_array)
        found = jax.grad(lambda n: _number_of(eqx.combine(n, rest), **_TIGHT))(numbers)
        for name, (where, length) in _THETA.items():
            value, slope = np.asarray(where(theta)), np.asarray(where(found))
            step = np.where(slope != 0, length * np.sign(slope) * np.where(np.isfinite(value), np.abs(value), 0.0), 0.0)
            assert np.any(step)
            changed = theta
            if name == "active bound":  # which moves past where the others start
                changed = eqx.tree_at(lambda t: t[0].cameras, theta, everything().cameras)
            high, low = (float(_number_of(eqx.tree_at(where, changed, value + s), **_TIGHT)) for s in (step, -step))
            np.testing.assert_allclose(np.sum(slope * step), (high - low) / 2, rtol=1e-3, err_msg=name)


def _grad(problem: Problem, cost: str = "final_cost", **options: object) -> None:
    def of(std_px: jax.Array) -> jax.Array:
        changed = eqx.tree_at(lambda p: p.observations.std_px, problem, std_px)
        return getattr(jaxba.solve_tiled(changed, loss=Huber(1.0), num_tiles=4, **options), cost)

    with jax.enable_x64(True):
        jax.grad(of)(np.asarray(problem.observations.std_px))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: _grad(everything(), max_nfev=1), "stopped before it converged"),
        (lambda: _grad(_fixed()), r"report\.problem of a solve before; this one leaves out: .*image"),
        (lambda: _grad(everything(), "initial_cost", ftol=1e-2), "only final_cost has a derivative"),
        (lambda: jax.jit(lambda p: jaxba.solve_tiled(p).points)(everything()), "traced, as inside jit and vmap"),
    ],
)
def test_what_has_no_gradient_is_refused(call: Callable[[], None], message: str) -> None:
    with pytest.raises(JaxbaError, match=message):
        call()


def test_a_front_that_is_not_positive_definite_raises_the_damping(monkeypatch: pytest.MonkeyPatch) -> None:
    # breaks where the refusal of a step ends the solve, or leaves a wrong factor behind
    problem, loss = _KINDS["everything"][0](), _KINDS["everything"][1]
    eliminate, calls = Engine.eliminate, []

    def fails_at_first(self: Engine, number: int, *arguments: object, **options: object) -> np.ndarray:
        calls.append(number)
        if len(calls) == 5:
            from jaxba.ba.tiles._dense import NotPositive

            raise NotPositive
        return eliminate(self, number, *arguments, **options)

    monkeypatch.setattr(Engine, "eliminate", fails_at_first)
    solution = jaxba.solve_tiled(problem, loss=loss, num_tiles=4, **_TIGHT)
    history = solution.report.history
    assert not history[1].accepted and history[1].trust > history[0].trust
    np.testing.assert_allclose(solution.final_cost, _whole("everything", 60).final_cost, rtol=1e-9)
