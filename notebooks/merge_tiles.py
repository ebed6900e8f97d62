# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From one tile to a merged block
#
# A large block can be cut into tiles that overlap, each adjusted on its own, and merged again. What does that cost
# beside an adjustment of the whole block? This notebook goes the way once, on a synthetic survey of 100 photos that
# knows its truth, with GNSS of 3 cm and half a pixel of noise.

# %%
import dataclasses

import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxba

jax.config.update("jax_enable_x64", True)  # costs are summed in double precision
survey = jaxba.synthetic.uav_block(100, side_overlap=0.7, points_per_image=40.0, num_check=40, seed=1)
problem, truth = survey.problem, survey.truth
print(problem.num_images, "images,", problem.num_points, "points,", problem.num_observations, "observations")

# %% [markdown]
# Tiles have at most 50 images of their own, and take over 24 more from their neighbours.

# %%
partition = jaxba.partition(problem, max_images=50, overlap=24)
for number, tile in enumerate(partition.tiles):
    print(f"tile {number}: {tile.own.sum()} images of its own, {(~tile.own).sum()} more, {len(tile.points)} points")
print(partition.is_separator.sum(), "images in several tiles,", partition.is_left_out.sum(), "points in none")

# %% [markdown]
# A tile is a problem like any other.

# %%
first = jaxba.solve(partition.tiles[0].problem)
print(first.result, "after", int(first.num_steps), "steps, focal length", np.round(first.cameras.fx, 2), "px")

# %% [markdown]
# All of them are a batch. Each finds a focal length of its own, since none sees what the others see.

# %%
solutions = jaxba.solve_batch([tile.problem for tile in partition.tiles])
for number, solution in enumerate(solutions):
    print(f"tile {number}: {solution.result}, focal length {solution.cameras.fx[0]:.2f} px")
print("the true one is", truth.cameras.fx[0], "px")
tiles = [
    dataclasses.replace(tile, problem=solution.apply(tile.problem))
    for tile, solution in zip(partition.tiles, solutions, strict=True)
]

# %% [markdown]
# Similarities lay the tiles onto each other, and shared images and points get the mean of what the tiles say.

# %%
laid = jaxba.merge_tiles(problem, tiles, global_pass=False)
print(*laid.summary(), sep="\n")

# %% [markdown]
# The global pass moves all points first, then the images where tiles meet with the points that they see. All else is
# held.

# %%
merged = jaxba.merge_tiles(problem, tiles)
for name, solution in zip(("points", "images where tiles meet"), merged.solutions, strict=True):
    print(f"{name}: cost from {solution.initial_cost:.0f} to {solution.final_cost:.0f}, {solution.result}")

# %% [markdown]
# The exact answer takes the same steps as an adjustment in one piece, tile by tile.

# %%
exact = jaxba.solve_tiled(problem, num_tiles=2)
print(exact.result, "after", int(exact.num_steps), "steps, focal length", np.round(exact.cameras.fx, 2), "px")

# %% [markdown]
# The price: the block's cost, and how far camera positions and check points are from the truth.


# %%
def cost(block):
    """Half the sum of squared residuals over their sigmas."""
    errors = jaxba.reprojection_errors(block) / block.observations.std_px
    unknowns = jaxba.ba.Unknowns(block.poses, block.cameras.parameters, block.antenna, block.points)
    return 0.5 * float(np.sum(errors**2) + sum(np.sum(prior.residual(unknowns) ** 2) for prior in block.priors))


def off_m(block):
    """Distances from the truth of camera positions and check points."""
    check = truth.check_index
    ends = (block.poses.center, truth.poses.center), (block.points[check], truth.points[check])
    return [np.linalg.norm(np.asarray(found) - np.asarray(true), axis=1) for found, true in ends]


ways = {"similarities": laid.problem, "and global pass": merged.problem, "exact": exact.apply(problem)}
print("way               cost over exact   positions, RMS (m)   check points, RMS (m)")
for name, block in ways.items():
    positions, points = (np.sqrt(np.mean(off**2)) for off in off_m(block))
    print(f"{name:16s} {cost(block) / cost(ways['exact']):16.4f} {positions:20.4f} {points:23.4f}")
assert cost(ways["exact"]) < cost(ways["and global pass"]) < cost(ways["similarities"])

# %% [markdown]
# Camera positions of the merged block against the exact ones, a colour a tile. Images that only one tile has stay as
# this tile placed them.

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 4.6), sharex=True, sharey=True)
best = np.asarray(ways["exact"].poses.center)
for axis, name in zip(axes, ("similarities", "and global pass"), strict=True):
    shift = np.asarray(ways[name].poses.center) - best
    axis.scatter(*best[:, :2].T, c=partition.owner, cmap="Set2", s=50)
    axis.scatter(*best[merged.shared, :2].T, facecolors="none", edgecolors="k", s=90, label="in the global pass")
    arrows = axis.quiver(*best[:, :2].T, *shift[:, :2].T, angles="xy", scale_units="xy", scale=0.001)
    axis.quiverkey(arrows, 0.1, 0.06, 0.02, "2 cm", labelpos="E")
    axis.set(xlabel="east (m)", ylabel="north (m)", title=f"{name}: off the exact positions", aspect="equal")
axes[0].legend(loc="upper left", bbox_to_anchor=(0, -0.12))
figure.tight_layout()
plt.show()
