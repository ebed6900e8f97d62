"""A pair's matches: what the geometry of a few of them leads to, against the true pairs of two made images."""

import numpy as np
import pytest
from test_overlap import SIZE, two_images

from jaxba.vision import PairMatches, PairOptions, Pinhole, View, _pair, match_pair
from jaxba.vision._guided import guided_matches
from jaxba.vision._nearest import Descriptors, match_descriptors

OPTIONS = PairOptions(ratio=0.75, threshold_px=3.0, epipolar_threshold_px=None, confidence=0.99, min_inliers=12)
LEVEL_LINES = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 300]])  # y_2 = x_2 + 300, as of images moved by (., 300)
Image = tuple[np.ndarray, np.ndarray, Descriptors]


def share_of_true(first: Image, second: Image, matches: np.ndarray) -> tuple[float, float]:
    """Return how many of the matches are right, and how many of the true pairs are found."""
    right = first[0][matches[:, 0]] == second[0][matches[:, 1]]
    return float(right.mean()), float(right.sum() / len(np.intersect1d(first[0], second[0])))


def known(first: Image, second: Image, count: int) -> np.ndarray:
    """Return some true pairs."""
    _, rows, columns = np.intersect1d(first[0], second[0], return_indices=True)
    return np.stack([rows, columns], axis=1)[:: len(rows) // count]


def guided(first: Image, second: Image, fundamental: np.ndarray, verified: np.ndarray) -> np.ndarray:
    found, distinctiveness = guided_matches(
        first[2], second[2], first[1], second[1], SIZE, verified, fundamental, line_px=3.0, ratio=0.75
    )
    assert len(found) == len(distinctiveness) and np.all((distinctiveness > 0.25) & (distinctiveness < 1))
    return found


def pair(first: Image, second: Image) -> PairMatches:
    pinhole = Pinhole(width_px=SIZE[0], height_px=SIZE[1], focal_px=None)
    views = [View(xy_px=xy_px, descriptors=descriptors, pinhole=pinhole) for _, xy_px, descriptors in (first, second)]
    return match_pair(*views, OPTIONS, None)


def test_features_that_have_doubles_are_found_in_their_place() -> None:
    first, second = two_images((200, 300), relief_px=20.0, doubles=24)
    _, among_all = share_of_true(first, second, match_descriptors(first[2], second[2], 0.75)[0])
    right, found = share_of_true(first, second, guided(first, second, LEVEL_LINES, known(first, second, 40)))
    assert right > 0.999 and found > 0.8 and among_all < 0.5


def test_a_place_does_not_make_a_match_of_unlike_features() -> None:
    first, second = two_images((200, 300))
    rng = np.random.default_rng(1)
    shuffled = second[2].take(rng.permutation(len(second[1])))
    shuffled = Descriptors(values=shuffled.values, kind="histogram", first_index=np.arange(len(second[1])))
    assert len(guided(first, (second[0], second[1], shuffled), LEVEL_LINES, known(first, second, 40))) < 5


def test_features_off_their_line_or_out_of_reach_are_no_match() -> None:
    first, second = two_images((200, 300))
    verified = known(first, second, 40)
    lost = np.ones(len(second[1]), bool)
    lost[verified[:, 1]] = False
    for off in ((0.0, 5.0), (200.0, 0.0)):
        moved = second[1] + lost[:, None] * off
        found = guided(first, (second[0], moved, second[2]), LEVEL_LINES, verified)
        assert set(map(tuple, found)) <= set(map(tuple, verified)) and len(found) > 0.9 * len(verified)


def test_nothing_is_found_where_all_is_foretold_outside_the_image() -> None:
    first, second = two_images((200, 300))
    beyond = second[0], second[1] + [1e5, 0.0], second[2]
    assert len(guided(first, beyond, LEVEL_LINES, known(first, second, 40))) == 0


def test_matches_on_one_line_stay_those_of_the_largest_features() -> None:
    """No homography foretells a place from them."""
    _, _, looks = two_images((0, 0), count=25000)[0]
    looks = Descriptors(values=looks.first(2000).values, kind="histogram", first_index=np.arange(2000))
    along = np.column_stack([np.linspace(0, SIZE[0], 2000), np.full(2000, 600.0)])
    found = pair((np.arange(2000), along, looks), (np.arange(2000), along + np.array([50.0, 0.0]), looks))
    assert found.two_view.num_inliers >= 1500 and np.all(found.matches[:, 0] == found.matches[:, 1])


@pytest.mark.parametrize(("shift", "turn"), [((300, 200), 0.0), ((-500, 300), 3.0), ((0, 700), 0.4)])
@pytest.mark.parametrize("relief", [0.0, 30.0])
def test_the_largest_features_lead_to_the_matches_of_all(
    shift: tuple[float, float], turn: float, relief: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = two_images(shift, turn, relief)
    searched = []
    monkeypatch.setattr(_pair, "common_ground", lambda *given: searched.append(1))
    found = pair(first, second)
    right, share = share_of_true(first, second, found.matches[found.two_view.is_inlier])
    assert not searched and right > 0.999 and share > 0.97
    assert found.two_view.num_inliers <= found.num_putative


def test_more_features_are_searched_where_the_largest_do_not_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = two_images((300, 200), relief_px=30.0)
    by_largest = pair(first, second)
    monkeypatch.setattr(_pair, "_LARGEST", (30, 120))  # of which a dozen are in both
    found = pair(first, second)
    right, share = share_of_true(first, second, found.matches[found.two_view.is_inlier])
    assert right > 0.999 and share > 0.97
    assert abs(found.two_view.num_inliers - by_largest.two_view.num_inliers) < 0.01 * found.two_view.num_inliers


@pytest.mark.parametrize("count", [0, 1, 2, 10])
def test_few_features_or_different_ground_make_no_match(count: int) -> None:
    first, second = two_images((300, 200))
    few = first[0][:count], first[1][:count], first[2].first(count)
    for one, two in ((few, second), (second, few)):
        found = pair(one, two)
        assert found.two_view.model == "none" and found.two_view.num_inliers == 0
    found = pair(*two_images((5000, 0)))
    assert found.two_view.model == "none" and found.num_putative < 5
