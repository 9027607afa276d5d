"""Horizons of disks that are clipped along the limb: by lines across it, with a template that is clipped alike."""

from __future__ import annotations

from giantlike.core.arrays import Float
from giantlike.core.outcomes import Failure
from giantlike.processing.limb.measurement import LimbMeasurement
from giantlike.processing.limb.view import LimbView
from giantlike.ray_tracing import Body, Reflectance
from giantlike.relative.horizon.geometry import Figure
from giantlike.relative.limb.fix import IteratedSearch, ScanOptions
from giantlike.relative.limb.line_scan import measure_by_lines
from giantlike.relative.limb.profiles import LimbScanOptions
from giantlike.shapes import Ellipsoid


def measure_clipped(
    view: LimbView, figure: Figure, law: Reflectance, position_km: Float, search: IteratedSearch, options: ScanOptions
) -> LimbMeasurement | Failure:
    """Measure the horizon of an ellipsoid that is clipped all along by lines, whose template is clipped alike.

    ``position_km`` in camera axes; returned as by :func:`giantlike.relative.limb.line_scan.measure_by_lines`.
    """
    body = Body(
        shape=Ellipsoid(radii_km=figure.radii_km),
        reflectance=law,
        camera_from_body=figure.camera_from_axes,
        position_camera_km=position_km,
        air=figure.air,
    )
    lines = LimbScanOptions(
        edges=options.edges, window_px=options.window_px, min_contrast=options.min_contrast, psf_error=options.psf_error
    )
    return measure_by_lines(view, body, search, lines)
