"""Readers and writers of files: images, SPICE kernels, cameras, geometry and ephemeris tables."""

from giantlike.core.deprecation import forward_names
from giantlike.core.observer import ObserverState
from giantlike.io.ephemeris_table import read_ephemeris_table
from giantlike.io.fits import navigation_header, write_fits
from giantlike.io.geometry_table import read_geometry, write_geometry
from giantlike.io.image_files import ImageFile, read_image_file
from giantlike.io.spice import SpiceKernels, load_kernels

__all__ = [
    "ImageFile",
    "ObserverState",
    "SpiceKernels",
    "load_kernels",
    "navigation_header",
    "read_ephemeris_table",
    "read_geometry",
    "read_image_file",
    "write_fits",
    "write_geometry",
]

__getattr__ = forward_names(__name__, {"giantlike._system.atomic": "write_bytes_atomic write_text_atomic"}, until="0.4")
