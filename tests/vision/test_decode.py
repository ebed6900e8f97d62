from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from jaxba import JaxbaError
from jaxba.vision import decode


@pytest.fixture
def rgb() -> np.ndarray:
    rng = np.random.default_rng(0)
    return cv2.GaussianBlur(rng.integers(0, 255, (90, 120, 3), dtype=np.uint8), (0, 0), 2)


def test_jpeg_has_the_values_that_opencv_decodes(tmp_path: Path, rgb: np.ndarray) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(rgb).save(path, quality=95)
    pixels = decode(path)
    expected = cv2.imread(str(path))
    assert expected is not None
    assert np.abs(pixels.rgb.astype(int) - expected[:, :, ::-1]).max() <= 2  # two builds of libjpeg
    assert np.abs(pixels.gray.astype(int) - cv2.cvtColor(expected, cv2.COLOR_BGR2GRAY)).max() <= 2


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9, 0.995])
def test_jpeg_that_ends_early_is_refused_by_name(tmp_path: Path, rgb: np.ndarray, share: float) -> None:
    whole, path = tmp_path / "whole.jpg", tmp_path / "cut.jpg"
    Image.fromarray(rgb).save(whole)
    content = whole.read_bytes()
    path.write_bytes(content[: round(share * len(content))])
    with pytest.raises(JaxbaError, match=r"cut\.jpg cannot be decoded .*copy it from the card again"):
        decode(path)


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_other_formats_that_end_early_are_refused_by_name(tmp_path: Path, rgb: np.ndarray, suffix: str) -> None:
    whole, path = tmp_path / f"whole.{suffix}", tmp_path / f"cut.{suffix}"
    Image.fromarray(rgb).save(whole)
    content = whole.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(JaxbaError, match="cut"):
        decode(path)


def test_what_is_no_image_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "notes.jpg"
    path.write_text("no image")
    with pytest.raises(JaxbaError, match=r"notes\.jpg cannot be decoded"):
        decode(path)
    with pytest.raises(JaxbaError, match=r"gone\.jpg does not exist"):
        decode(tmp_path / "gone.jpg")


def test_files_of_which_only_the_tags_are_broken_are_decoded_whole(data_dir: Path) -> None:
    paths = sorted((data_dir / "exif").rglob("*.jp*g"))
    assert len(paths) == 10
    for path in paths:
        pixels, expected = decode(path), cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        assert expected is not None and pixels.rgb.shape == expected.shape
        assert np.abs(pixels.rgb.astype(int) - expected[:, :, ::-1]).max() <= 6, path.name  # two builds of libjpeg


def test_orientation_turns_no_pixel(tmp_path: Path, rgb: np.ndarray) -> None:
    path = tmp_path / "turned.jpg"
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(rgb).save(path, exif=exif)
    assert decode(path).gray.shape == (90, 120)


@pytest.mark.parametrize("mode", ["L", "RGBA", "CMYK", "P", "1"])
def test_every_mode_gives_gray_and_rgb(tmp_path: Path, rgb: np.ndarray, mode: str) -> None:
    path = tmp_path / ("a.tif" if mode == "CMYK" else "a.png")
    if mode == "CMYK":
        path = tmp_path / "a.jpg"
    Image.fromarray(rgb).convert(mode).save(path)
    pixels = decode(path)
    assert pixels.gray.shape == (90, 120) and pixels.rgb.shape == (90, 120, 3)
    with Image.open(path) as image:
        stored = np.asarray(image.convert("RGB"))  # a palette and black and white hold few of the colours
    assert np.abs(pixels.rgb.astype(int) - stored).max() <= 1
    assert np.abs(pixels.gray.astype(int) - cv2.cvtColor(stored, cv2.COLOR_RGB2GRAY)).max() <= 1
    if mode not in ("P", "1"):
        assert np.abs(pixels.gray.astype(int) - cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)).max() <= 12


@pytest.mark.parametrize("shape", [(90, 120), (90, 120, 3)])
@pytest.mark.parametrize("kind", ["uint16", "float32"])
def test_deep_tiff_is_stretched_to_8_bits(tmp_path: Path, shape: tuple[int, ...], kind: str) -> None:
    path = tmp_path / "deep.tif"
    ramp = np.broadcast_to(np.linspace(1000, 4000, 120), shape[:2])
    values = np.repeat(ramp[:, :, None], 3, axis=2) if len(shape) == 3 else ramp
    assert cv2.imwrite(str(path), values.astype(kind))
    gray = decode(path).gray
    expected = np.broadcast_to(np.linspace(0, 255, 120), (90, 120))
    assert np.abs(gray - expected).max() < 2


def test_deep_png_is_stretched_to_8_bits(tmp_path: Path) -> None:
    path = tmp_path / "deep.png"
    assert cv2.imwrite(str(path), np.tile(np.linspace(1000, 4000, 120), (90, 1)).astype(np.uint16))
    assert np.abs(decode(path).gray - np.linspace(0, 255, 120)).max() < 2


def test_noise_of_a_black_deep_frame_is_not_stretched(tmp_path: Path) -> None:
    path = tmp_path / "black.tif"
    noise = np.random.default_rng(0).integers(0, 4, (90, 120)).astype(np.uint16)
    assert cv2.imwrite(str(path), noise)
    assert decode(path).gray.max() <= 3


def test_missing_values_of_a_thermal_frame_do_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "thermal.tif"
    values = np.tile(np.linspace(10, 30, 120), (90, 1)).astype(np.float32)
    values[:5] = np.nan
    assert cv2.imwrite(str(path), values)
    gray = decode(path).gray
    assert gray[:5].max() == 0 and gray[50].max() == 255
