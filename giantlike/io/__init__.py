"""Readers and writers of files: images, SPICE kernels, cameras, geometry and ephemeris tables."""

from giantlike._system.atomic import write_bytes_atomic, write_text_atomic
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
    "write_bytes_atomic",
    "write_fits",
    "write_geometry",
    "write_text_atomic",
]
