"""Statistics of a run in words: how measurements scatter, which unknowns cannot be told apart."""

import json

import numpy as np

from jaxba.report import statistics_facts, statistics_rows
from jaxba.report._summary import finite
from jaxba.scene import MeasuredKind, SurveyStatistics


def kind(name: str, unit: str, std: float, taken_std: float = float("nan"), *, is_known: bool = True) -> MeasuredKind:
    return MeasuredKind(
        name=name,
        unit=unit,
        count=20,
        redundancy=15.0 if is_known else 2.0,
        std=std,
        std_share=0.18,
        taken_std=taken_std,
        is_known=is_known,
    )


FOUND = SurveyStatistics(
    redundancy=1000,
    kinds=(
        kind("tie points", "px", 0.1683),
        kind("position horizontal", "m", 0.0184, 0.03),
        kind("position vertical", "m", 6.3, 5.0),
        kind("attitude", "deg", 1.42),
        kind("control horizontal", "m", 0.012, 0.02, is_known=False),
    ),
    unknowns=("fx", "fy", "k1", "position offset x"),
    unknown_std=np.array([0.1, 0.1, 1e-4, 0.0]),
    correlation=np.array(
        [[1, 0.99, -0.3, np.nan], [0.99, 1, -0.84, np.nan], [-0.3, -0.84, 1, np.nan], [np.nan] * 4], float
    ),
)


def test_each_kind_is_told_beside_what_it_was_taken_for() -> None:
    facts = json.loads(json.dumps(finite(statistics_facts(FOUND))))  # as summary.json has them
    assert statistics_rows(facts) == [
        (
            "scatter",
            "tie points 0.17 px, positions across 0.018 m (taken as 0.030), positions up 6.30 m (taken as 5.00), "
            "attitudes 1.4 deg; too little redundancy to tell those of control across",
        ),
        ("correlated", "fx and fy +0.99, fy and k1 -0.84"),
    ]


def test_nothing_is_said_where_nothing_is_known() -> None:
    assert statistics_rows(statistics_facts(None)) == []
    bare = SurveyStatistics(redundancy=0, kinds=(), unknowns=(), unknown_std=np.zeros(0), correlation=np.zeros((0, 0)))
    assert statistics_rows(statistics_facts(bare)) == []
