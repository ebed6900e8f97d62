"""Partners of photos without a position, by what they look like: what is added, what stays, and when nothing is."""

import dataclasses

import numpy as np
from small_survey import NUM_PHOTOS, Survey

from jaxba.pipeline import PIPELINE, Run, retrieval


def run_of(made: Survey, tmp_path) -> Run:
    return made.copy(tmp_path).run(until="retrieval")


def test_pairs_that_positions_have_found_stay_as_they_are(made: Survey, tmp_path) -> None:
    # breaks where features count for surveys that need none of it, and every change of them looks like one of pairs
    done = run_of(made, tmp_path).done
    inputs = PIPELINE["retrieval"].inputs(done)
    assert len(inputs.features) == 0 and len(inputs.by_order) == 0
    np.testing.assert_array_equal(done.retrieval.pairs, done.pairs.pairs)
    np.testing.assert_array_equal(done.retrieval.overlap, done.pairs.overlap)
    assert done.retrieval.num_added == 0


def test_photos_without_a_position_get_partners_that_look_alike(made: Survey, tmp_path) -> None:
    """The two that look most like each photo of a survey overlap with it by more than others."""
    done = run_of(made, tmp_path).done
    last = NUM_PHOTOS - 1
    first_pair = np.array([[0, last]], np.int32)
    done.pairs = dataclasses.replace(
        done.pairs, pairs=first_pair, overlap=np.array([0.3]), by_order=np.arange(NUM_PHOTOS)
    )
    inputs = PIPELINE["retrieval"].inputs(done)
    assert len(inputs.features) == NUM_PHOTOS
    found = retrieval.run(inputs, retrieval.Params(neighbours=2))
    overlap = dict(zip(map(tuple, done.retrieval.pairs.tolist()), done.retrieval.overlap, strict=True))
    added = [tuple(pair) for pair in found.pairs.tolist() if pair != [0, last]]
    assert found.num_added == len(added) >= NUM_PHOTOS and found.num_photos == NUM_PHOTOS
    chosen = [overlap[pair] for pair in added if pair in overlap]
    others = [share for pair, share in overlap.items() if pair not in added]
    assert len(chosen) > 0.9 * len(added) and np.mean(chosen) > np.mean(others) + 0.05
    assert np.array_equal(found.pairs, np.unique(found.pairs, axis=0)) and found.pairs.dtype == np.int32
    known = np.flatnonzero(np.isfinite(found.overlap))
    assert found.pairs[known].tolist() == [[0, last]] and found.overlap[known].tolist() == [0.3]
    none = retrieval.run(inputs, retrieval.Params(neighbours=0))
    np.testing.assert_array_equal(none.pairs, first_pair)
