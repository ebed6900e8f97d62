"""Lists of scale bars, and their results as CSV."""

import csv
from pathlib import Path

import pytest

from jaxba._errors import JaxbaError
from jaxba.io import BAR_RESULT_COLUMNS, parse_bars, write_csv_bars


@pytest.mark.parametrize(
    "text",
    [
        "first,second,length_m,std_m\nA,B,12.5,0.002\nB,C 1,7,\n",
        "# bars of May\nPoint 1;Point 2;Distance (m);Accuracy (m)\nA;B;12.5;0.002\nB;C 1;7;0\n",
        "length\tstd\tto\tfrom\n12.5\t0.002\tB\tA\n7\t\tC 1\tB\n",
    ],
)
def test_columns_go_by_name(text: str) -> None:
    one, two = parse_bars(text)
    assert (one.first, one.second, one.length_m, one.std_m) == ("A", "B", 12.5, 0.002)
    assert (two.first, two.second, two.length_m, two.std_m) == ("B", "C 1", 7.0, None)


def test_lines_without_a_header_are_read() -> None:
    one, two = parse_bars("A B 12.5 0.002\n\nB C 7\n", "bars.txt")
    assert (one.std_m, two.first, two.std_m, two.source) == (0.002, "B", None, "bars.txt line 3")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "bars.csv: is empty; give a line a bar"),
        ("first,second,length_m\n", "bars.csv: lists no bar"),
        ("first,second,std_m\nA,B,1\n", "bars.csv line 1: columns first, second, std_m lack length_m"),
        ("A B\n", "bars.csv line 1: 'A B' has 2 columns; give a line a bar"),
        ("first,second,length (ft)\nA,B,3\n", "bars.csv line 1: length (ft) is in ft; give metres"),
        ("A B 1 2 3\n", "has 5 columns"),
        ("A A 1\n", "line 1: the bar begins and ends at A"),
        ("A B 12,5\n", "line 1: length_m '12,5' is no number"),
        ("A B -3\n", "line 1: length_m -3; give metres above 0"),
        ("A B 3 -0.1\n", "line 1: std_m -0.1; give metres above 0"),
        ("first,second,length_m\nA,,1\n", "line 2: second is empty"),
        ("A B 1\nB A 1\n", "line 2: the bar from B to A stands in bars.csv line 1 as well"),
    ],
)
def test_what_cannot_be_is_refused_with_its_line(text: str, message: str) -> None:
    with pytest.raises(JaxbaError) as refused:
        parse_bars(text)
    assert message in str(refused.value)


def test_results_are_read_back_with_what_is_not_known_empty(tmp_path: Path) -> None:
    known = {
        "first": "A, east", "second": "B", "role": "control", "length_m": 12.5, "std_m": 0.002, "adjusted_m": 12.503,
        "adjusted_std_m": 0.001, "residual_m": 0.003, "over_sigma": 1.26, "used": True, "set_aside": False,
    }  # fmt: skip
    unknown = {**known, "adjusted_m": float("nan"), "over_sigma": float("nan"), "used": False}
    write_csv_bars(tmp_path / "bars.csv", [known, unknown])
    with open(tmp_path / "bars.csv", encoding="utf-8", newline="") as file:
        one, two = csv.DictReader(file)
    assert list(one) == list(BAR_RESULT_COLUMNS)
    assert (one["first"], one["adjusted_m"], one["over_sigma"], one["used"]) == ("A, east", "12.5030", "1.3", "yes")
    assert (two["adjusted_m"], two["over_sigma"], two["used"], two["set_aside"]) == ("", "", "no", "no")
