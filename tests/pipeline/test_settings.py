import dataclasses
from typing import get_args, get_type_hints

import pytest

from jaxba import JaxbaError
from jaxba.engine import changed, explained, from_toml, to_toml
from jaxba.engine._parameters import Parameters, allowed, parameter
from jaxba.pipeline import PIPELINE, STAGES

EVERY = [(stage, field) for stage in STAGES for field in dataclasses.fields(stage.module.Params)]


@pytest.mark.parametrize(("stage", "field"), EVERY, ids=lambda x: getattr(x, "name", None))
def test_every_parameter_has_a_meaning_and_a_default_in_its_range(stage, field):
    assert len(field.metadata["help"]) > 10
    assert field.default is not dataclasses.MISSING
    low, high = field.metadata["low"], field.metadata["high"]
    kind = int if int in (*get_args(get_type_hints(stage.module.Params)[field.name]), type(field.default)) else float
    for outside in [kind(bound + step) for bound, step in ((low, -1), (high, 1)) if bound is not None]:
        with pytest.raises(JaxbaError, match=f"{stage.name}.{field.name}=.* is out of range; allowed: "):
            stage.module.Params(**{field.name: outside})


@pytest.mark.parametrize(
    ("text", "value"), [("match.ratio=0.7", 0.7), ("match.min_inliers=20", 20), ("crs.target_crs=EPSG:32615", None)]
)
def test_a_change_changes_that_parameter_alone(text, value):
    before, after = PIPELINE.settings, changed(PIPELINE.settings, [text])
    stage, name = text.split("=")[0].split(".")
    assert getattr(after[stage], name) == (value or "EPSG:32615")
    assert {s for s in before if before[s] != after[s]} == {stage}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("match.ratio", "write section.name=value"),
        ("ratio=0.7", "write section.name=value"),
        ("matches.ratio=0.7", "no section 'matches'; did you mean match"),
        ("tie.ratio=0.7", "the sections, each a table in TOML, are metadata, crs"),
        ("match.rato=0.7", "no parameter match.rato; did you mean ratio"),
        ("match.ratio=0.9", "match.ratio=0.9 is out of range; allowed: 0.6 to 0.85"),
        ("match.ratio=nan", "out of range"),
        ("match.ratio=high", "match.ratio=high: give a number"),
        ("match.min_inliers=12.5", "give a whole number"),
        ("features.detector=surf", "allowed: auto, sift, orb, akaze, aliked, xfeat"),
        (
            "features.condition=rows,snow",
            "low_light, rows, .* or several of them with commas between",
        ),
        ("tracks.require_connected=maybe", "give true or false"),
    ],
)
def test_a_bad_change_says_what_is_allowed(text, message):
    with pytest.raises(JaxbaError, match=message):
        changed(PIPELINE.settings, [text])


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("tiles.chunk_size=200", 200),
        ("tiles.overlap=40", 40),
        ("tiles.max_observations=2e6", 2e6),
        ("tiles.by=flight-line", "flight-line"),
    ],
)
def test_tiles_can_be_set_and_say_whom_they_are_for(text, value):
    name = text.split("=")[0]
    assert getattr(changed(PIPELINE.settings, [text])["tiles"], name.split(".")[1]) == value
    meanings = {row[0]: row[3] for row in explained(PIPELINE.settings)}
    # a run's tiles make up the block again: how they meet does not matter
    assert meanings[name].startswith("for jaxba partition") == (name != "tiles.chunk_size")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tiles.chunk_size=50", "tiles.chunk_size=50 is out of range; allowed: 100 to 5000"),
        ("tiles.overlap=5", "tiles.overlap=5 is out of range; allowed: 10 to 1500"),
        ("tiles.max_observations=100", "tiles.max_observations=100.0 is out of range; allowed: 10000 or more"),
        ("tiles.by=time", "allowed: space, flight-line"),
    ],
)
def test_tiles_out_of_range_are_refused(text, message):
    with pytest.raises(JaxbaError, match=message):
        changed(PIPELINE.settings, [text])


def test_none_is_a_value_only_where_it_is_allowed():
    assert changed(PIPELINE.settings, ["match.ransac_threshold=none"])["match"].ransac_threshold is None
    with pytest.raises(JaxbaError, match="give a number"):
        changed(PIPELINE.settings, ["match.ratio=none"])


def test_allowed_says_ranges_in_words():
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Params(Parameters):
        a: int = parameter(1, low=1, help="at least one")
        b: float = parameter(1.0, high=2, help="at most two")
        c: str = parameter("x", help="anything")

    assert [allowed(field) for field in dataclasses.fields(Params)] == ["1 or more", "2 or less", ""]


def test_a_toml_of_all_settings_reads_back_as_they_were(tmp_path):
    settings = changed(PIPELINE.settings, ["match.ratio=0.7", 'crs.target_crs=a "b" \\ c\n\td\x7f', "adjust.ftol=1e-9"])
    for explain in (False, True):
        (tmp_path / "jaxba.toml").write_text(to_toml(settings, explain=explain))
        assert from_toml(tmp_path / "jaxba.toml", PIPELINE.settings) == settings


def test_a_toml_changes_what_it_names_and_nothing_else(tmp_path):
    (tmp_path / "a.toml").write_text("[match]\nransac_threshold = 2\n[features]\nnfeatures = 3000\n")
    before = changed(PIPELINE.settings, ["match.ratio=0.7"])
    after = from_toml(tmp_path / "a.toml", before)
    assert after == changed(before, ["match.ransac_threshold=2", "features.nfeatures=3000"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[match]\nratio = 0.9\n", r"a\.toml: match\.ratio=0\.9 is out of range; allowed: 0\.6 to 0\.85"),
        (
            "[match]\nrato = 0.7\n",
            r"a\.toml: no parameter match\.rato; did you mean ratio\? the parameters of",
        ),
        ("[macht]\nratio = 0.7\n", r"a\.toml: no section 'macht'; did you mean match\? the sections"),
        ("ratio = 0.7\n", r"a\.toml: no section 'ratio'"),
        ("match = 3\n", r"a\.toml: no section 'match'"),
        ("[match]\nmin_inliers = 12.5\n", r"a\.toml: match\.min_inliers=12\.5: give a whole number"),
        ("[match]\nratio = [1]\n", r"a\.toml: match\.ratio=\[1\]: give a number"),
        ("[match\n", r"a\.toml: is not valid TOML .*line 1"),
    ],
)
def test_a_bad_toml_is_refused_with_the_file_and_what_is_allowed(tmp_path, text, message):
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(JaxbaError, match=message):
        from_toml(tmp_path / "a.toml", PIPELINE.settings)


def test_a_toml_that_is_not_there_or_no_text_is_refused(tmp_path):
    with pytest.raises(JaxbaError, match=r"a\.toml: there is no such file"):
        from_toml(tmp_path / "a.toml", PIPELINE.settings)
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(JaxbaError, match=r"b\.toml: cannot be read as text"):
        from_toml(tmp_path / "b.toml", PIPELINE.settings)


def test_every_parameter_is_explained_once():
    rows = explained(PIPELINE.settings)
    assert len({name for name, *_ in rows}) == len(rows)
    assert dict((name, (default, range_)) for name, default, range_, _ in rows)["match.ratio"] == (
        "0.75",
        "0.6 to 0.85",
    )
