"""Camera models: from a point in the camera's frame (x right, y down, z forward) to a pixel.

Pixels: the centre of the first pixel is (0.5, 0.5). Named fields instead of positional parameters; each field is a
scalar, or an array with one entry a camera that broadcasts against the points. A model is its fields and one method,
`project_components`, on separate x, y, z: the solver differentiates that with jax over long contiguous arrays.

Fields and formulas are COLMAP's for the models that COLMAP has (sensor/models.h) and OpenCV's for `k3`; `BAL` is that
of Bundle Adjustment in the Large (Agarwal et al. 2010) turned to look along +z with y down.
"""

import abc
import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

Parameter = Float[Array | np.ndarray, "*cameras"] | float


class AbstractCamera(eqx.Module):
    """Camera model with named fields, batched over leading axes.

    `sees_behind`: whether the model's formula is used for points behind the camera, too.
    """

    sees_behind: ClassVar[bool] = False

    @abc.abstractmethod
    def project_components(self, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
        """Return the pixel coordinates of points given by components, elementwise."""

    @abc.abstractmethod
    def focal_and_center(self) -> tuple[Parameter, Parameter, Parameter, Parameter]:
        """Return (fx, fy, cx, cy) in pixels."""

    @classmethod
    def parameter_names(cls) -> tuple[str, ...]:
        """Names of the intrinsics, in the order of `parameters`."""
        return tuple(field.name for field in dataclasses.fields(cls))

    @property
    def parameters(self) -> Float[Array, "*cameras parameters"]:
        """All intrinsics on a last axis."""
        return jnp.stack(jnp.broadcast_arrays(*(jnp.asarray(getattr(self, n)) for n in self.parameter_names())), -1)

    @classmethod
    def from_parameters(cls, parameters: Float[Array | np.ndarray, "*cameras parameters"]) -> "AbstractCamera":
        """Return the camera whose intrinsics lie on the last axis, in the order of `parameter_names`."""
        return cls(*(parameters[..., i] for i in range(len(cls.parameter_names()))))

    def project(self, point_in_cam: Float[Array, "*#batch 3"]) -> Float[Array, "*#batch 2"]:
        """Return the pixel of a point in the camera's frame; meaningful for z > 0 (fisheye: any direction)."""
        point = jnp.asarray(point_in_cam)
        return jnp.stack(self.project_components(point[..., 0], point[..., 1], point[..., 2]), axis=-1)

    def unproject(self, xy_px: Float[Array, "*#batch 2"]) -> Float[Array, "*#batch 3"]:
        """Return the unit direction, in the camera's frame, that projects to a pixel; NaN where none does.

        Newton's method on the distortion, the pixel moved out from the centre to its place: exact to rounding within
        the part of the image where the distortion is monotonic, and NaN beyond. The last two steps alone carry
        derivatives, which makes them the implicit function's, exact to third order, at the cost of two steps.
        """
        xy_px = jnp.asarray(xy_px)
        fixed, pixel = jax.lax.stop_gradient((self, xy_px))
        fx, fy, cx, cy = fixed.focal_and_center()
        parameters = [getattr(fixed, name) for name in self.parameter_names()]
        shape = jnp.broadcast_shapes(pixel.shape[:-1], *(jnp.shape(p) for p in parameters))
        center = jnp.stack(jnp.broadcast_arrays(jnp.asarray(cx), jnp.asarray(cy)), axis=-1)

        def step(i: Array | int, plane: Array) -> Array:
            share = jnp.minimum(1.0, (i + 1) / _OUTWARD_STEPS).astype(plane.dtype)
            return fixed._newton_step(plane, center + share * (pixel - center))[0]

        plane = jnp.zeros((2, *shape), jnp.result_type(pixel, *parameters))
        plane = jax.lax.fori_loop(0, _OUTWARD_STEPS + _NEWTON_STEPS, step, plane)
        _, residual, (du_da, du_db, dv_da, dv_db) = fixed._newton_step(plane, pixel)
        # a root on the near side of every fold: both eigenvalues of the distortion's derivative are positive
        monotonic = (du_da * dv_db > du_db * dv_da) & (du_da / fx + dv_db / fy > 0)
        found = monotonic & (jnp.max(jnp.abs(residual), axis=0) < _CONVERGED * jnp.minimum(fx, fy))
        plane = jnp.where(found, plane, 0.0)  # keeps what is differentiated finite
        for _ in range(2):
            plane = self._newton_step(plane, xy_px)[0]
        ray = jnp.stack(self._ray(plane[0], plane[1]), axis=-1)
        return jnp.where(found[..., None], ray / jnp.linalg.norm(ray, axis=-1, keepdims=True), jnp.nan)

    def undistort(self, xy_px: Float[Array, "*#batch 2"]) -> Float[Array, "*#batch 2"]:
        """Return the pixel at which the pinhole camera with the same focal length and centre sees the same ray.

        NaN where no direction projects to the pixel, or one at 90 degrees or more from the axis.
        """
        fx, fy, cx, cy = self.focal_and_center()
        ray = self.unproject(xy_px)
        ahead = ray[..., 2] > 0
        z = jnp.where(ahead, ray[..., 2], 1.0)
        xy = jnp.stack([fx * (ray[..., 0] / z) + cx, fy * (ray[..., 1] / z) + cy], axis=-1)
        return jnp.where(ahead[..., None], xy, jnp.nan)

    def _newton_step(
        self, plane: Float[Array, "2 *n"], xy_px: Float[Array, "*m 2"]
    ) -> tuple[Array, Array, tuple[Array, Array, Array, Array]]:
        """Return the next (a, b), the residual in pixels at this one, and the derivative of pixel by (a, b)."""
        a, b = plane
        zero, one = jnp.zeros_like(a), jnp.ones_like(a)
        (u, v), (du_da, dv_da) = jax.jvp(self._distort, (a, b), (one, zero))
        _, (du_db, dv_db) = jax.jvp(self._distort, (a, b), (zero, one))
        ru, rv = u - xy_px[..., 0], v - xy_px[..., 1]
        determinant = du_da * dv_db - du_db * dv_da
        step = jnp.stack([dv_db * ru - du_db * rv, du_da * rv - dv_da * ru]) / determinant
        return plane - step, jnp.stack([ru, rv]), (du_da, du_db, dv_da, dv_db)

    def _distort(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Pixel of the direction `_ray(a, b)`."""
        return self.project_components(a, b, jnp.ones_like(a))

    def _ray(self, a: Array, b: Array) -> tuple[Array, Array, Array]:
        return a, b, jnp.ones_like(a)


_OUTWARD_STEPS = 8  # one Newton step at each: stays on the branch that starts at the centre, which one jump could leave
_NEWTON_STEPS = 8  # four are enough for most lenses; near a fold, where the distortion is flat, each halves the error
_CONVERGED = 1e-5  # residual over focal length that the last two steps take to rounding


class SimplePinhole(AbstractCamera):
    """Pinhole with one focal length."""

    f: Parameter
    cx: Parameter
    cy: Parameter

    def focal_and_center(self) -> tuple[Parameter, Parameter, Parameter, Parameter]:
        return self.f, self.f, self.cx, self.cy

    def project_components(self, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
        return x / z * self.f + self.cx, y / z * self.f + self.cy


class Pinhole(AbstractCamera):
    """Pinhole with a focal length an axis."""

    fx: Parameter
    fy: Parameter
    cx: Parameter
    cy: Parameter

    def focal_and_center(self) -> tuple[Parameter, Parameter, Parameter, Parameter]:
        return self.fx, self.fy, self.cx, self.cy

    def project_components(self, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
        return x / z * self.fx + self.cx, y / z * self.fy + self.cy


class SimpleRadial(AbstractCamera):
    """One focal length and one radial term: `1 + k1 r^2`."""

    f: Parameter
    cx: Parameter
    cy: Parameter
    k1: Parameter

    def focal_and_center(self) -> tuple[Parameter, Parameter, Parameter, Parameter]:
        return self.f, self.f, self.cx, self.cy

    def project_components(self, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
        a, b = x / z, y / z
        scale = (1 + (a * a + b * b) * self.k1) * self.f
        return scale * a + self.cx, scale * b + self.cy


class Radial(AbstractCamera):
    """One focal length and two radial terms: `1 + k1 r^2 + k2 r^4`."""

    f: Parameter
    cx: Parameter
    cy: Parameter
    k1: Parameter
    k2: Parameter

    def focal_and_center(self) -> tuple[Parameter, Parameter, Parameter, Parameter]:
        return self.f, self.f, self.cx, self.cy

    def project_components(self, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
        a, b = x / z, y / z
        r2 = a * a + b * b
        scale = (1 + r2 * (r2 * self.k2 + self.k1)) * self.f
        return scale * a + self.cx, scale * b + self.cy


class OpenCV(AbstractCamera):
    """OpenCV's model: radial k1, k2, (k3) and tangential p1, p2 (Brown 1966)."""

    fx: Parameter
    fy: Parameter
    cx: Parameter
    cy: Parameter
    k1: Parameter
    k2: Parameter
    p1: Parameter
    p2: Parameter
    k3: Parameter = 0.0

    def focal_and_center(self) -> tuple[Parameter, Parameter, Parameter, Parameter]:
        return self.fx, self.fy, self.cx, self.cy

    def project_components(self, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
        a, b = x / z, y / z
        aa, ab, bb = a * a, a * b, b * b
        r2 = aa + bb
        radial = 1 + r2 * (r2 * (r2 * self.k3 + self.k2) + self.k1)
        u = a * radial + 2 * ab * self.p1 + (r2 + 2 * aa) * self.p2
        v = b * radial + (r2 + 2 * bb) * self.p1 + 2 * ab * self.p2
        return u * self.fx + self.cx, v * self.fy + self.cy


class OpenCVFisheye(AbstractCamera):
    """OpenCV's fisheye: `theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)` (Kannala and Brandt 2006).

    Directions beyond 90 degrees have pixels as well; the one opposite to the axis has none (NaN).
    """

    sees_behind: ClassVar[bool] = True

    fx: Parameter
    fy: Parameter
    cx: Parameter
    cy: Parameter
    k1: Parameter
    k2: Parameter
    k3: Parameter
    k4: Parameter

    def focal_and_center(self) -> tuple[Parameter, Parameter, Parameter, Parameter]:
        return self.fx, self.fy, self.cx, self.cy

    def project_components(self, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
        squared = x * x + y * y
        near_axis = (squared < 1e-6 * (z * z)) & (z > 0)
        tangent = squared / jnp.square(jnp.where(near_axis, z, 1.0))
        radius = jnp.sqrt(jnp.where(near_axis, 1.0, squared))
        series = (1 - tangent / 3 + tangent * tangent / 5) / jnp.where(near_axis, z, 1.0)
        ratio = jnp.where(near_axis, series, jnp.arctan2(radius, z) / radius)  # theta over radius
        scale = ratio * self._polynomial(ratio * ratio * squared)
        return scale * x * self.fx + self.cx, scale * y * self.fy + self.cy

    def _polynomial(self, t2: Array) -> Array:
        return 1 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4)))

    # (a, b) is the angle from the axis times the direction in the image plane, so rays beyond 90 degrees exist too

    def _distort(self, a: Array, b: Array) -> tuple[Array, Array]:
        scale = self._polynomial(a * a + b * b)
        return scale * a * self.fx + self.cx, scale * b * self.fy + self.cy

    def _ray(self, a: Array, b: Array) -> tuple[Array, Array, Array]:
        squared = a * a + b * b
        small = squared < 1e-8
        theta = jnp.sqrt(jnp.where(small, 1.0, squared))
        sinc = jnp.where(small, 1 - squared / 6, jnp.sin(theta) / theta)
        cosine = jnp.where(small, 1 - squared / 2 + squared * squared / 24, jnp.cos(theta))
        return sinc * a, sinc * b, cosine


class BAL(AbstractCamera):
    """Bundle Adjustment in the Large, looking along +z: `f (1 + k1 r^2 + k2 r^4)`, principal point at the origin.

    Published problems hold points behind their cameras and count them in the cost, so these are projected like others.
    """

    sees_behind: ClassVar[bool] = True

    f: Parameter
    k1: Parameter
    k2: Parameter

    def focal_and_center(self) -> tuple[Parameter, Parameter, Parameter, Parameter]:
        return self.f, self.f, 0.0, 0.0

    def project_components(self, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
        a, b = x / z, y / z
        r2 = a * a + b * b
        scale = (1 + r2 * (r2 * self.k2 + self.k1)) * self.f
        return scale * a, scale * b


CAMERAS: dict[str, type[AbstractCamera]] = {
    "SIMPLE_PINHOLE": SimplePinhole,
    "PINHOLE": Pinhole,
    "SIMPLE_RADIAL": SimpleRadial,
    "RADIAL": Radial,
    "OPENCV": OpenCV,
    "OPENCV_FISHEYE": OpenCVFisheye,
    "BAL": BAL,
}
"""Models by the name that files use; COLMAP's where COLMAP has the model."""
