"""Pairs by likeness beside pairs by order: `python -m benchmarks.retrieval project/`, a project that was matched.

Of the pairs that were verified there (from footprints, or of all with all: `--set pairs.method=exhaustive`) it prints
which share each way finds, of all and of the better half by matches, were no position known. By a random order: were
photos also named and timed at random.
"""

import sys
import time
from pathlib import Path

import numpy as np

from jaxba.engine import Project, from_toml
from jaxba.pipeline import PIPELINE, pairs, retrieval, run_pipeline
from jaxba.scene import rising_pairs, window_pairs
from jaxba.vision import alike_pairs

_WINDOW = pairs.Params().window  # photos before and after
_NEIGHBOURS = retrieval.Params().neighbours  # most alike photos


def main(folder: Path) -> None:
    settings = from_toml(folder / "jaxba.toml", PIPELINE.settings)
    given, _ = Project(folder, make=False).read_given()
    done = run_pipeline(given.photos, folder, settings, until="match").done
    assert done.features is not None and done.match is not None
    graph, images = done.match.view_graph, np.arange(len(done.photos))
    verified, inliers = graph.pairs[graph.is_edge], graph.num_inliers[graph.is_edge]
    better = inliers >= np.median(inliers)
    begun = time.perf_counter()
    alike = alike_pairs(done.features, images, _NEIGHBOURS)
    print(f"{len(images)} photos, {len(verified)} verified pairs; likeness took {time.perf_counter() - begun:.1f} s\n")
    print(
        "| pairs | candidates | of all pairs | verified found | of the better half |\n| --- | --- | --- | --- | --- |"
    )
    by_order = window_pairs(images, _WINDOW)
    at_random = window_pairs(np.random.default_rng(0).permutation(images), _WINDOW)
    ways = {
        "by order": by_order,
        "by likeness": alike,
        "both": rising_pairs(np.concatenate([by_order, alike])),
        "both, random order": rising_pairs(np.concatenate([at_random, alike])),
    }
    num_all = len(images) * (len(images) - 1) // 2
    for name, chosen in ways.items():
        known = set(map(tuple, chosen.tolist()))
        found = np.array([tuple(pair) in known for pair in verified.tolist()])
        share = len(chosen) / num_all
        print(f"| {name} | {len(chosen)} | {share:.0%} | {found.mean():.1%} | {found[better].mean():.1%} |")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
