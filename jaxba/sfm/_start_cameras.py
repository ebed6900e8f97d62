"""Cameras to start from: the focal length of the photos, the image's centre, no distortion."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxba._errors import JaxbaError
from jaxba.geometry import CAMERAS
from jaxba.scene import Block, Photo

_GUESSED_FOCAL = 1.2  # of the longer side
_FOCAL_STD, _GUESSED_FOCAL_STD = 0.03, 0.2


@dataclasses.dataclass(frozen=True, eq=False)
class StartCameras:
    """One set of parameters for each `Photo.camera` of the component, in the order of first use."""

    model: str
    names: tuple[str, ...]
    of_image: Int[np.ndarray, " images"]  # -1 outside the component
    parameters: Float[np.ndarray, "cameras parameters"]
    focal_std: Float[np.ndarray, " cameras"]
    notes: tuple[str, ...]

    @staticmethod
    def of(photos: Sequence[Photo], component: Int[np.ndarray, " n"], model: str) -> "StartCameras":
        names = tuple(dict.fromkeys(photos[i].camera for i in component))
        of_image = np.full(len(photos), -1)
        of_image[component] = [names.index(photos[i].camera) for i in component]
        parameters, std, notes = [], [], []
        for row, name in enumerate(names):
            mine = [photos[i] for i in component if of_image[i] == row]
            sizes = {(p.width_px, p.height_px) for p in mine}
            if len(sizes) > 1:
                raise JaxbaError(
                    f"camera {name}: its photos have {len(sizes)} sizes ({mine[0].name} is {mine[0].width_px} x "
                    f"{mine[0].height_px}); photos of one camera share a pixel grid."
                )
            width, height = sizes.pop()
            known = [p.focal_px for p in mine if p.focal_px is not None]
            focal = float(np.median(known)) if known else _GUESSED_FOCAL * max(width, height)
            std.append(_FOCAL_STD if known else _GUESSED_FOCAL_STD)
            if not known:
                notes.append(
                    f"Camera {name}: no focal length is known; the start is {focal:.0f} px, {_GUESSED_FOCAL:g} times "
                    "the longer side."
                )
            values = {"f": focal, "fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2}
            parameters.append([values.get(n, 0.0) for n in CAMERAS[model].parameter_names()])
        return StartCameras(model, names, of_image, np.array(parameters), np.array(std), tuple(notes))

    def block(self, image_index: Int[np.ndarray, " images"], quaternion: Float[np.ndarray, "images 4"]) -> Block:
        """Return a block of images at the origin, without points."""
        return Block(
            image_index=image_index,
            quaternion=quaternion,
            translation_m=np.zeros((len(image_index), 3)),
            camera_model=self.model,
            camera_names=self.names,
            camera_parameters=self.parameters,
            camera_index=self.of_image[image_index],
            points_m=np.zeros((0, 3)),
            track_index=np.zeros(0, int),
            rgb=np.zeros((0, 3), np.uint8),
            observation_image=np.zeros(0, int),
            observation_point=np.zeros(0, int),
            observation_xy_px=np.zeros((0, 2)),
            is_georeferenced=False,
        )


def used_cameras(block: Block) -> Block:
    used, index = np.unique(block.camera_index, return_inverse=True)
    return dataclasses.replace(
        block,
        camera_names=tuple(block.camera_names[k] for k in used),
        camera_parameters=block.camera_parameters[used],
        camera_index=index,
    )
