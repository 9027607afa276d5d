"""Options of renders: sampling, shadows and the size of the Sun."""

from __future__ import annotations

import math
from dataclasses import dataclass

from giantlike.core.arrays import require


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderOptions:
    """Options of :func:`~giantlike.ray_tracing.render`.

    Parameters
    ----------
    rays_per_pixel_side : int; rays along each side of a pixel: 2 means 4 rays a pixel
    min_rays_across : int; least number across the narrow side of the outline: small bodies need more
    shadows : bool; True if bodies cast shadows, on themselves and on each other
    margin_px : int, px; margin around the detector that is rendered too: the search range of a correlation
    jitter_seed : int, optional; of random positions of rays in cells, so that truth and template differ; else centers
    sun_radius_rad : float, rad
        Angular radius of the Sun at the body; 0 is a point. An extended Sun gives penumbrae and a soft terminator. Its
        disk is evenly bright: solar limb darkening is left out.
    sun_samples : int; points of the solar disk that each ray is bounced to, where the Sun is extended
    sun_seed : int; seed of the positions of these points in their strata; equal seeds give equal images
    threads : int; number of threads; the image is the same, to the last bit, for any number

    Raises
    ------
    InputError
        A value is out of its range.
    """

    rays_per_pixel_side: int = 2
    min_rays_across: int = 256
    shadows: bool = True
    margin_px: int = 0
    jitter_seed: int | None = None
    sun_radius_rad: float = 0.0
    sun_samples: int = 16
    sun_seed: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        require(
            1 <= self.rays_per_pixel_side <= 32,
            f"rays_per_pixel_side must be in [1, 32], got {self.rays_per_pixel_side}",
        )
        require(1 <= self.min_rays_across <= 1024, f"min_rays_across must be in [1, 1024], got {self.min_rays_across}")
        require(0 <= self.margin_px <= 4096, f"margin_px must be in [0, 4096], got {self.margin_px}")
        require(
            math.isfinite(self.sun_radius_rad) and 0.0 <= self.sun_radius_rad < 0.5,
            f"sun_radius_rad must be in [0, 0.5), got {self.sun_radius_rad}",
        )
        require(1 <= self.sun_samples <= 1024, f"sun_samples must be in [1, 1024], got {self.sun_samples}")
        require(1 <= self.threads <= 256, f"threads must be in [1, 256], got {self.threads}")
        require(self.sun_seed >= 0, f"sun_seed must be >= 0, got {self.sun_seed}")


DEFAULT_OPTIONS = RenderOptions()  # four rays a pixel and 256 across at least: see benchmarks/render_accuracy.py
