"""`jaxba config`, and where a run takes its settings from."""

import json
import re
from pathlib import Path

import pytest
from commands import Cli
from PIL import Image

from jaxba.engine import explained, from_toml
from jaxba.pipeline import PIPELINE


@pytest.fixture
def cli(cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Cli:
    """Run a command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return cli


def test_what_is_printed_is_a_file_that_can_be_used(cli, tmp_path: Path):
    code, out, _ = cli("config")
    (tmp_path / "printed.toml").write_text(out)
    assert code == 0 and from_toml(tmp_path / "printed.toml", PIPELINE.settings) == PIPELINE.settings
    assert "# nearest over second nearest descriptor distance (default 0.75; 0.6 to 0.85)\nratio = 0.75\n" in out


def test_every_parameter_is_explained_with_default_range_and_meaning(cli):
    text = re.sub(r"\s+", " ", cli("config", "--explain")[1])
    for name, default, allowed, meaning in explained(PIPELINE.settings):
        assert re.sub(r"\s+", " ", f"{name} {default}{f' ({allowed})' if allowed else ''}: {meaning}") in text
    rows = json.loads(cli("config", "--json")[1])["parameters"]
    assert {"name": "match.ratio", "default": "0.75", "allowed": "0.6 to 0.85"}.items() <= rows[
        [row["name"] for row in rows].index("match.ratio")
    ].items()


PUBLISHED = {  # the defaults and ranges that users of such pipelines know
    "crs.target_crs": ("none", ""),
    "crs.h_accuracy_threshold": ("2", "0.05 to 100"),
    "crs.altitude_variance": ("0.05", "0.01 to 0.5"),
    "features.detector": ("auto", "auto, sift, orb, akaze, aliked, xfeat"),
    "features.nfeatures": ("none", "2000 to 20000"),
    "features.contrast_threshold": ("none", "0.02 to 0.08"),
    "features.edge_threshold": ("none", "5 to 20"),
    "features.sigma": ("1.6", "1 to 2.5"),
    "match.ratio": ("0.75", "0.6 to 0.85"),
    "match.ransac_threshold": ("none", "0.5 to 5"),
    "match.confidence": ("0.99", "0.9 to 0.9999"),
    "match.min_inliers": ("12", "8 to 30"),
    "match.min_good": ("30", "8 to 100"),
    "match.min_inlier_ratio": ("0.35", "0.2 to 0.8"),
    "adjust.loss": ("huber", "linear, soft_l1, huber, cauchy, arctan, tukey, geman_mcclure"),
    "adjust.f_scale": ("1", "0.5 to 5"),
    "adjust.max_nfev": ("500", "100 to 5000"),
    "adjust.ftol": ("1e-08", "1e-12 to 1e-06"),
    "adjust.xtol": ("1e-08", "1e-12 to 1e-06"),
    "adjust.track_threshold": ("2", "1 to 4"),
    "adjust.mad_factor": ("2.5", "2 to 5"),
    "adjust.edge_median_limit": ("3", "2 to 6"),
    "tiles.chunk_size": ("500", "100 to 5000"),
    "tiles.overlap": ("50", "10 to 1500"),
    "tiles.max_observations": ("none", "10000 or more"),
    "tiles.by": ("space", "space, flight-line"),
    "workers.max_memory": ("0.8", ""),
    "verify.max_median_px": ("1", "0.1 to 5"),
    "verify.min_inlier_rate": ("0.9", "0.5 to 1"),
    "match.epipolar_threshold": ("none", "0.5 to 3"),
    "match.fallback_nfeatures": ("12000", "2000 to 20000"),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_published_defaults_and_ranges_are_kept(name: str):
    found = {row[0]: row[1:3] for row in explained(PIPELINE.settings)}
    assert found[name] == PUBLISHED[name]


def test_the_file_of_the_working_folder_counts_and_is_said(cli, tmp_path: Path):
    (tmp_path / "jaxba.toml").write_text("[match]\nratio = 0.9\n")
    (tmp_path / "photos").mkdir()
    message = "match.ratio=0.9 is out of range; allowed: 0.6 to 0.85"
    for command in (("config",), ("run", "photos")):
        code, _, err = cli(*command)
        assert code == 2 and message in err
    (tmp_path / "jaxba.toml").write_text("[match]\nratio = 0.7\n")
    Image.new("L", (640, 480), 90).save(tmp_path / "photos" / "a.jpg")
    code, _, err = cli("run", "photos", "--stage", "metadata")
    assert code == 0 and err.startswith(f"settings are those of {tmp_path / 'jaxba.toml'}\n")
    assert from_toml(tmp_path / "project" / "jaxba.toml", PIPELINE.settings)["match"].ratio == 0.7  # pyright: ignore


def test_set_wins_over_the_file_and_the_file_over_the_default(cli, tmp_path: Path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "my.toml").write_text("[match]\nratio = 0.7\nmin_good = 40\n[crs]\nstd_h = 2\n")
    Image.new("L", (640, 480), 90).save(tmp_path / "photos" / "a.jpg")
    cli("run", "photos", "--stage", "metadata", "--config", "my.toml", "--set", "match.ratio=0.65")
    settings = from_toml(tmp_path / "project" / "jaxba.toml", PIPELINE.settings)
    assert (settings["match"].ratio, settings["match"].min_good) == (0.65, 40)  # pyright: ignore
    assert settings["crs"].std_h == 2.0 and settings["crs"].std_v == 5.0  # pyright: ignore
