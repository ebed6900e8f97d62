"""Cells of lists: heights that are none, and names of photos however a list writes them."""

import unicodedata

import pytest
from hypothesis import given, settings, strategies as st

from jaxba._errors import JaxbaError
from jaxba.io import like_photo, match_geotags, parse_control, parse_geotags, photo_finder, photo_names, without_fillers
from jaxba.io._list_cells import FILLERS, HEIGHTS

NONE = [None, 0.0, -9999.0, -99999.0, -32768.0, -32767.0, -999.0, 9999.0, -3.4028235e38, 1e20, -9965.2]


def measured(z: list[float | None], **options) -> tuple[list[float | None], str]:
    kept, notes = without_fillers(z, [f"p{k}" for k in range(len(z))], "list.txt", kind="point", **options)
    return kept, " ".join(notes)


@pytest.mark.parametrize("none", NONE)
@pytest.mark.parametrize("others", [[248.06, 252.29, 246.67, 250.1], [812.5, 1250.25, 1640.0], [-31.2, -29.5, -30.3]])
def test_words_for_no_height_are_none_among_heights(none: float | None, others: list[float]):
    kept, notes = measured([others[0], none, *others[1:]])
    assert kept == [others[0], None, *others[1:]]
    assert f"1 of {len(others) + 1} points has no height (" in notes and ": p1)" in notes


@pytest.mark.parametrize(
    ("z", "kept", "words"),
    [
        ([0.0, 0.0, 0.0], [None] * 3, "all heights are 0"),
        ([0.0, None, -9999.0], [None] * 3, "all heights are 0"),
        ([-9999.0] * 3, [None] * 3, "3 of 3 points have no height (-9999: p0, p1, p2)"),
        ([9999.0] * 3, [None] * 3, "3 of 3 points have no height (9999: p0, p1, p2)"),
        ([0.0, 0.0, 301.2], [None, None, 301.2], "2 of 3 points have no height (0 where the others are 301.2 to 301.2"),
        ([0.0, 1.3, 3.4, -0.8], [0.0, 1.3, 3.4, -0.8], "the height 0 of p0 is used, since others are near it"),
        ([3.1, 3.05, 0.0, 3.12], [3.1, 3.05, None, 3.12], "0 where the others are 3.05 to 3.12"),
        ([5.2, 120.7, 0.0, 300.4], [5.2, 120.7, 0.0, 300.4], "is used"),
        ([248.0, 999.0, 251.0], [248.0, None, 251.0], "999 where the others are"),
        ([1001.5, 999.0, 997.2], [1001.5, 999.0, 997.2], ""),
        ([248.0, 251.0], [248.0, 251.0], ""),
        ([], [], ""),
    ],
)
def test_a_number_is_no_height_where_the_list_says_so(z: list, kept: list, words: str):
    found, notes = measured(z)
    assert found == kept and words in notes and bool(notes) == bool(words)


def test_zeros_that_are_asked_for_are_heights():
    assert measured([0.0, 250.0, -9999.0], keep_zeros=True)[0] == [0.0, 250.0, None]
    assert measured([0.0, 0.0], keep_zeros=True) == ([0.0, 0.0], "")
    assert "If so, X." in measured([0.0, 250.0], cure=" If so, X.")[1]
    assert measured([0.0, 0.0], cure=" If so, X.")[1].endswith("not measured. If so, X.")


heights = st.floats(*HEIGHTS, allow_subnormal=False).filter(lambda z: min(abs(z - f) for f in FILLERS) > 10)


@given(st.lists(heights, min_size=1, max_size=6), st.lists(st.sampled_from(NONE), max_size=4), st.randoms())
@settings(max_examples=200)
def test_heights_stay_and_what_is_none_goes_in_any_order(real: list[float], none: list[float | None], random):
    z = [*real, *none]
    random.shuffle(z)
    kept, notes = measured(z)
    assert kept == [value if value in real else None for value in z]
    assert bool(notes) == bool(none)


@given(st.lists(st.floats(*HEIGHTS), max_size=6))
@settings(max_examples=200)
def test_a_height_is_dropped_only_where_a_note_names_it(z: list[float]):
    kept, notes = measured(list(z))
    for k, (before, after) in enumerate(zip(z, kept, strict=True)):
        assert after in (before, None)
        assert after is not None or before in FILLERS
        assert after is not None or f"p{k}" in notes or "all heights are 0" in notes


NAMES = [
    "DJI_0003 (2).JPG",
    "flight 1/späte Aufnahme.jpg",
    "IMG.JPG - Kopie.JPG",
    "a b  c.tif",
    "É è.png",
    "O'Neil 1.jpg",
]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "spelled",
    [
        lambda name: name,
        lambda name: unicodedata.normalize("NFD", name),
        lambda name: unicodedata.normalize("NFC", name).upper(),
        lambda name: f'"{name}"',
        lambda name: name.rpartition("/")[2],
        lambda name: name.replace("/", "\\"),
        lambda name: f"D:\\survey\\{name.rpartition('/')[2]}",
    ],
)
@pytest.mark.parametrize(
    ("geo", "gcp"),
    [
        ("{} 1 2 3", "1 2 3 4 5 {} gcp 01"),
        ("{}\t1\t2\t3", "1\t2\t3\t4\t5\t{}\tgcp"),
        ("{}\t\t1\t\t2\t\t3", "1\t\t2\t3\t\t4\t5\t\t{}\t\tgcp"),
        ("{}   \t 1 \t 2 \t 3 ", "1  2 3\t4 5  {} \t gcp \t more"),
    ],
)
def test_names_are_found_as_lists_write_them(name: str, spelled, geo: str, gcp: str):
    photos = [*NAMES, "IMG.JPG", "a b.tif", "DJI_0003.JPG"]
    is_photo = photo_names(photos)
    tags = parse_geotags("EPSG:32615\n" + geo.format(spelled(name)), is_photo=is_photo)
    found, _ = match_geotags(tags, photos)
    assert list(found) == [name] and (found[name].position.x, found[name].position.z_m) == (1.0, 3.0)
    (point,) = parse_control("EPSG:32615\n" + gcp.format(spelled(name)), is_photo=is_photo).points
    assert point.name == "gcp" and photo_finder(photos)(point.marks[0].image, "line 2") == name


letters = st.characters(categories=("L", "N"), include_characters=" ()-_.,'&+=")
stems = (
    st.text(letters, min_size=1, max_size=12)
    .map(lambda text: " ".join(text.split()))
    .filter(lambda text: text.strip(" "))
)


@given(stems, st.sampled_from(["NFC", "NFD"]), st.sampled_from(["NFC", "NFD"]), st.sampled_from(" \t"), st.booleans())
@settings(max_examples=100)
def test_a_name_in_either_unicode_form_is_found_between_blanks_or_tabs(
    stem: str, on_disk: str, in_list: str, separator: str, is_quoted: bool
):
    photo = unicodedata.normalize(on_disk, f"{stem}.jpg")
    written = unicodedata.normalize(in_list, photo)
    written = f'"{written}"' if is_quoted else written
    tags = parse_geotags(f"EPSG:32615\n{separator.join([written, '1', '2', '3'])}", is_photo=photo_names([photo]))
    assert list(match_geotags(tags, [photo])[0]) == [photo]
    text = f"EPSG:32615\n{separator.join(['1', '2', '3', '4', '5', written, 'gcp01'])}"
    (point,) = parse_control(text, is_photo=photo_names([photo])).points
    assert point.name == "gcp01" and photo_finder([photo])(point.marks[0].image, "line 2") == photo


@pytest.mark.parametrize("x", ["1e13", "-1e308", "1_000", "1,5", "1e400"])
def test_a_number_that_is_no_coordinate_is_refused_by_line(x: str):
    with pytest.raises(JaxbaError, match=r"geo\.txt line 2: x '.*' is (too large|no number)"):
        parse_geotags(f"EPSG:32615\na.jpg {x} 2 3")
    with pytest.raises(JaxbaError, match=r"gcp_list\.txt line 2: x '.*' is (too large|no number)"):
        parse_control(f"EPSG:32615\n{x} 2 3 4 5 a.jpg")


def test_a_label_without_an_ending_is_the_photo_of_that_name_and_with_one_no_other():
    find = photo_finder(["one/DJI_1.JPG", "two/DJI_2.JPG", "two/DJI_2.tif"])
    assert find("DJI_1", "line 2") == "one/DJI_1.JPG" and find("DJI_1.tif", "line 2") is None
    with pytest.raises(JaxbaError, match=r"line 2: DJI_2 may be two/DJI_2\.JPG or two/DJI_2\.tif"):
        find("DJI_2", "line 2")
    assert find("DJI_2.jpg", "line 2") == "two/DJI_2.JPG"


@pytest.mark.parametrize("name", ["DJI_0003(2).JPG", "DJI-0003_(2).jpg", "DJI 0003 2.JPG", "x/dji_0003 [2].jpg"])
def test_a_name_that_differs_in_blanks_or_marks_is_named_with_the_one_that_it_resembles(name: str):
    photos = ["DJI_0003 (2).JPG", "DJI_0004.JPG"]
    assert photo_finder(photos)(name, "line 2") is None
    tags = parse_geotags(f'EPSG:32615\n"{name}" 1 2\nDJI_0004.JPG 1 2')
    notes = " ".join(match_geotags(tags, photos)[1])
    assert f"no usable photo: {name} (DJI_0003 (2).JPG, but for blanks or marks? Write it so)" in notes
    assert like_photo("DJI_0005.JPG", photos) == ""
