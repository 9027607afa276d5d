"""Rendering for limbs: tiles of the frame along one, and how bright a body is all along its outline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from giantlike.camera import Camera
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_floats
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure, Reason
from giantlike.ray_tracing import Body, RenderOptions, render

_TILE_PX = 48
_FOOTPRINT_PX = 3.0  # of the B-spline that samples the template
_OVERVIEW_RADIUS_PX = 48.0  # of the body where only its brightness along the outline is wanted
_OVERVIEW_BLUR_PX = 0.6
_OVERVIEW_DEPTH_PX = 1.0
_MAX_OVERVIEW_PX = 400


@dataclass(frozen=True, slots=True)
class WindowModel:
    """A camera model whose pixels are counted from another corner, and may have another size.

    Parameters
    ----------
    model : CameraModel
    corner_px : (2,) float64, px
        Pixel of ``model`` that becomes (0, 0).
    scale : float, px
        Pixels of ``model`` to one of the window.
    """

    type_name: ClassVar[str] = "window"
    parameter_names: ClassVar[tuple[str, ...]] = ()

    model: CameraModel
    corner_px: Float
    scale: float = 1.0

    @property
    def parameters(self) -> Float:
        """Those of the model inside (k,)."""
        return self.model.parameters

    def with_parameters(self, values: ArrayLike) -> Self:
        """Return the same window of a model with other parameters (k,)."""
        return type(self)(self.model.with_parameters(values), self.corner_px, self.scale)

    @property
    def focal_length_px(self) -> float:
        """Focal length along x, px."""
        return self.model.focal_length_px / self.scale

    def project(self, points_camera: ArrayLike) -> Float:
        """Pixels (..., 2) of points (..., 3) in camera axes."""
        return (self.model.project(points_camera) - self.corner_px) / self.scale

    def unproject(self, points_px: ArrayLike) -> Float:
        """Unit vectors (..., 3) in camera axes of pixels (..., 2)."""
        return self.model.unproject(self._of_model(points_px))

    def project_jacobian(self, points_camera: ArrayLike) -> Float:
        """Derivative (..., 2, 3) of ``project`` with respect to the point."""
        return self.model.project_jacobian(points_camera) / self.scale

    def unproject_jacobian(self, points_px: ArrayLike) -> Float:
        """Derivative (..., 3, 2) of ``unproject`` with respect to the pixel, 1/px."""
        return self.model.unproject_jacobian(self._of_model(points_px)) * self.scale

    def parameter_jacobian(self, points_camera: ArrayLike, temperature_c: float = 0.0) -> Float:
        """Derivative (..., 2, k) of the pixels at a temperature with respect to the parameters."""
        return self.model.parameter_jacobian(points_camera, temperature_c) / self.scale

    def at_temperature(self, temperature_c: float) -> Self:
        """Return the same window of the model at a temperature in degrees Celsius."""
        return type(self)(self.model.at_temperature(temperature_c), self.corner_px, self.scale)

    def _of_model(self, points_px: ArrayLike) -> Float:
        return self.scale * as_floats(points_px, (2,), "points_px") + self.corner_px


def render_near(
    places_px: Float,
    body: Body,
    camera: Camera,
    *,
    sun_direction_camera: Float,
    psf: GaussianPsf,
    rays_per_pixel_side: int,
) -> Float | Failure:
    """Brightness of a body in a frame, rendered where it is asked for.

    Parameters
    ----------
    places_px : (..., 2) float64, px
        Where the brightness is needed; what lies more than a tile away from all of them stays 0.
    body : Body
    camera : Camera
    sun_direction_camera : (3,) float64, unitless, camera axes
    psf : GaussianPsf
    rays_per_pixel_side : int

    Returns
    -------
    (rows, columns) float64 or Failure
        ``NOT_LIT`` or ``OUT_OF_FRAME`` when no light falls on any of the tiles.
    """
    frame = np.zeros((camera.rows, camera.columns))
    problem: Failure | None = Failure(Reason.OUT_OF_FRAME, "nothing to render lies in the frame")
    for x, y in _tiles(places_px.reshape(-1, 2), camera).tolist():
        columns, rows = min(_TILE_PX, camera.columns - x), min(_TILE_PX, camera.rows - y)
        template = render(
            body,
            WindowModel(camera.model, np.array([x, y], dtype=np.float64)),
            sun_direction_camera=sun_direction_camera,
            psf=psf,
            columns=columns,
            rows=rows,
            options=RenderOptions(rays_per_pixel_side=rays_per_pixel_side),
        )
        if isinstance(template, Failure):
            problem = template if problem is not None else None
            continue
        problem = None
        frame[y : y + rows, x : x + columns] = template.placed(columns, rows)
    return frame if problem is None else problem


def outline_brightness(
    points_px: Float,
    normals_px: Float,
    body: Body,
    model: CameraModel,
    *,
    sun_direction_camera: Float,
    radius_px: float,
) -> Float:
    """How bright a body is just inside its outline, a fiftieth of its radius deep.

    Parameters
    ----------
    points_px, normals_px : (n, 2) float64
        The outline and its outward normals; points that are not finite get 0.
    body : Body
    model : CameraModel
    sun_direction_camera : (3,) float64, unitless, camera axes
    radius_px : float, px
        Apparent radius of the body.

    Returns
    -------
    (n,) float64
        Over the brightest place of the body near these points; 0 everywhere where none of it is lit.

    Notes
    -----
    On the outline itself the cosine of the incidence angle says little: with the Sun behind the camera it is zero all
    around, however bright the limb.
    """
    brightness = np.zeros(len(points_px))
    good = np.isfinite(points_px).all(axis=1) & np.isfinite(normals_px).all(axis=1)
    if not good.any():
        return brightness
    low, high = points_px[good].min(axis=0), points_px[good].max(axis=0)
    scale = max(radius_px / _OVERVIEW_RADIUS_PX, float(np.max(high - low)) / _MAX_OVERVIEW_PX)
    corner = low - 4.0 * scale
    columns, rows = (np.ceil((high - corner) / scale).astype(int) + 5).tolist()
    template = render(
        body,
        WindowModel(model, corner, scale),
        sun_direction_camera=sun_direction_camera,
        psf=GaussianPsf(sigma_px=_OVERVIEW_BLUR_PX),
        columns=columns,
        rows=rows,
        options=RenderOptions(rays_per_pixel_side=2, min_rays_across=64),
    )
    if isinstance(template, Failure):
        return brightness
    light = template.placed(columns, rows)
    at = (points_px[good] - corner) / scale
    x, y = (at - _OVERVIEW_DEPTH_PX * normals_px[good]).T
    brightness[good] = map_coordinates(light, [y, x], order=1, mode="nearest") / light.max()
    return brightness


def _tiles(places_px: Float, camera: Camera) -> NDArray[np.int64]:
    """Corners (k, 2) of the tiles that hold the places, with what is needed around each."""
    reach = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]]) * _FOOTPRINT_PX
    corners = np.floor((places_px[:, None] + reach) / _TILE_PX).astype(np.int64).reshape(-1, 2)
    inside = np.all((corners >= 0) & (corners * _TILE_PX < [camera.columns, camera.rows]), axis=1)
    return np.unique(corners[inside], axis=0) * _TILE_PX
