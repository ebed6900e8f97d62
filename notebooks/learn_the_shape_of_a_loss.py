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
# # Learning the shape of the loss, without any truth
#
# Barron's loss has a shape: 2 is least squares, 1 a smooth absolute value, 0 Cauchy, below that ever less
# influence of large residuals. Which one fits a survey with 10%, or with 30%, wrong matches? `jaxba.tune` holds a
# tenth of the observations out of the fit and learns scale and shape so that the fit predicts *those* best. Check
# points, which it never sees, then tell whether the block got better, beside Huber's loss at one sigma, the usual
# default.

# %%
import matplotlib.pyplot as plt
import numpy as np

import jaxba

exact = jaxba.synthetic.uav_block(14, seed=2, pixel_std_px=0.0, num_check=40)
truth, check = exact.truth, exact.truth.check_index


def measured(seed, share):
    """Return the block with half a pixel of noise, and a share of its tie points' pixels wrong by 5 to 200."""
    rng = np.random.default_rng(seed)
    seen = exact.problem.observations
    xy_px = seen.xy_px + 0.5 * rng.normal(size=seen.xy_px.shape)
    tie = ~np.isin(seen.point_index, check)
    wrong = np.flatnonzero(tie)[rng.random(np.count_nonzero(tie)) < share]
    angle, length = rng.uniform(0, 2 * np.pi, len(wrong)), rng.uniform(5, 200, len(wrong))
    xy_px[wrong] += np.stack([length * np.cos(angle), length * np.sin(angle)], axis=1)
    observations = jaxba.Observations(xy_px, np.full(len(xy_px), 0.5), seen.image_index, seen.point_index)
    return jaxba.Problem(**{**vars(exact.problem), "observations": observations})


def check_point_rms(points):
    return float(np.sqrt(np.mean(np.sum((np.asarray(points)[check] - truth.points[check]) ** 2, axis=1))))


# %%
seeds, shares = range(6), (0.1, 0.3)
plan = jaxba.make_plan(measured(0, 0.1))
huber, tuned, learned = {}, {}, {}
for share in shares:
    problems = [measured(seed, share) for seed in seeds]
    huber[share] = [check_point_rms(jaxba.solve(p, loss=jaxba.Huber(1.0), plan=plan).points) for p in problems]
    found = [
        jaxba.tune(
            p, loss=jaxba.Barron(alpha=0.0, f_scale=1.0), learn=("loss scale", "loss shape"), hold_out=0.1, steps=8,
            learning_rate=0.4,
        )
        for p in problems
    ]  # fmt: skip
    tuned[share] = [
        check_point_rms(jaxba.solve(p, loss=t.loss, plan=plan).points) for p, t in zip(problems, found, strict=True)
    ]
    learned[share] = [t.learned for t in found]

print("wrong matches | Huber(1), mean RMS (m) | tuned, mean RMS (m) | shape | scale")
for share in shares:
    shape = np.mean([v["loss shape"] for v in learned[share]])
    scale = np.mean([v["loss scale"] for v in learned[share]])
    print(
        f"{share:13.0%} | {np.mean(huber[share]):22.4f} | {np.mean(tuned[share]):19.4f} | {shape:5.2f} | {scale:5.2f}"
    )

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 4.2))
for share in shares:
    axes[0].plot(huber[share], tuned[share], "o", label=f"{share:.0%} wrong")
largest = max(max(h) for h in huber.values())
axes[0].plot([0, largest], [0, largest], "k:", linewidth=1)
axes[0].set(xlabel="Huber(1): check points, RMS (m)", ylabel="tuned: check points, RMS (m)")
axes[0].set_title(f"{len(seeds)} seeds each")
axes[0].legend()
residual = np.linspace(0, 10, 200)
losses = {"Huber(1)": jaxba.Huber(1.0)}
for share in shares:
    shape, scale = (np.mean([v[name] for v in learned[share]]) for name in ("loss shape", "loss scale"))
    losses[f"learned at {share:.0%}"] = jaxba.Barron(alpha=shape, f_scale=scale)
for name, loss in losses.items():
    axes[1].plot(residual, np.asarray(loss.derivatives(np.square(residual))[1]), label=name)
axes[1].set(xlabel="residual (sigmas)", ylabel="weight", title="weight of an observation")
axes[1].legend()
figure.tight_layout()
plt.show()

# %%
for share in shares:
    assert np.mean(tuned[share]) < np.mean(huber[share])
