import dataclasses

import pytest

from jaxba import JaxbaError
from jaxba.pipeline import STAGES, changed, default_settings
from jaxba.pipeline._parameters import Parameters, allowed, parameter

EVERY = [(stage, field) for stage in STAGES for field in dataclasses.fields(stage.module.Params)]


@pytest.mark.parametrize(("stage", "field"), EVERY, ids=lambda x: getattr(x, "name", None))
def test_every_parameter_has_a_meaning_and_a_default_in_its_range(stage, field):
    assert len(field.metadata["help"]) > 10
    assert field.default is not dataclasses.MISSING
    low, high = field.metadata["low"], field.metadata["high"]
    kind = int if type(field.default) is int else float
    for outside in [kind(bound + step) for bound, step in ((low, -1), (high, 1)) if bound is not None]:
        with pytest.raises(JaxbaError, match=f"{stage.name}.{field.name}=.* is out of range; allowed: "):
            stage.module.Params(**{field.name: outside})


@pytest.mark.parametrize(
    ("text", "value"), [("match.ratio=0.7", 0.7), ("match.min_inliers=20", 20), ("crs.target_crs=EPSG:32615", None)]
)
def test_a_change_changes_that_parameter_alone(text, value):
    before, after = default_settings(), changed(default_settings(), [text])
    stage, name = text.split("=")[0].split(".")
    assert getattr(after[stage], name) == (value or "EPSG:32615")
    assert {s for s in before if before[s] != after[s]} == {stage}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("match.ratio", "write stage.name=value"),
        ("ratio=0.7", "write stage.name=value"),
        ("matches.ratio=0.7", "no stage 'matches'; the stages are metadata, crs"),
        ("match.rato=0.7", "did you mean ratio?"),
        ("match.ratio=0.9", "match.ratio=0.9 is out of range; allowed: 0.6 to 0.85"),
        ("match.ratio=nan", "out of range"),
        ("match.ratio=high", "match.ratio=high: give a number"),
        ("match.min_inliers=12.5", "give a whole number"),
        ("features.detector=surf", "allowed: sift, orb, akaze"),
        ("tracks.require_connected=maybe", "give true or false"),
    ],
)
def test_a_bad_change_says_what_is_allowed(text, message):
    with pytest.raises(JaxbaError, match=message):
        changed(default_settings(), [text])


def test_none_is_a_value_only_where_it_is_allowed():
    assert changed(default_settings(), ["match.ransac_threshold=none"])["match"].ransac_threshold is None
    with pytest.raises(JaxbaError, match="give a number"):
        changed(default_settings(), ["match.ratio=none"])


def test_allowed_says_ranges_in_words():
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Params(Parameters):
        a: int = parameter(1, low=1, help="at least one")
        b: float = parameter(1.0, high=2, help="at most two")
        c: str = parameter("x", help="anything")

    assert [allowed(field) for field in dataclasses.fields(Params)] == ["1 or more", "2 or less", ""]
