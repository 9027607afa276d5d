"""Cameras as sources of images: a folder, a folder that is being filled, a simulation."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from giantlike.camera import Camera
from giantlike.core.arrays import require, require_number
from giantlike.core.errors import DataError
from giantlike.core.outcomes import Failure, Reason
from giantlike.image import Image

IMAGE_SUFFIXES = (".fits", ".fit", ".png", ".tif", ".tiff", ".jpg", ".img")
"""Names that end so are images; all others in a folder are left alone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExposureRequest:
    """Requested exposure of a camera."""

    et: float  # middle of the exposure
    exposure_s: float

    def __post_init__(self) -> None:
        require_number(self.et, "et")
        require_number(self.exposure_s, "exposure_s", above=0.0)


class CameraSource(Protocol):
    """Camera as the modes of an instrument need it."""

    @property
    def camera(self) -> Camera:
        """Model, optics and detector."""
        ...

    def take(self, request: ExposureRequest) -> Image | Failure:
        """Take an image, or say why there is none."""
        ...


@dataclass(frozen=True, slots=True)
class SimulatedCamera:
    """A camera whose images a function makes."""

    camera: Camera
    make: Callable[[ExposureRequest], Image]  # takes an :class:`ExposureRequest`, returns an Image

    def take(self, request: ExposureRequest) -> Image | Failure:
        """Make an image."""
        return self.make(request)


@dataclass(slots=True)
class FolderCamera:
    """A camera whose images are the files of a folder, in the order of their names, each once."""

    camera: Camera
    folder: Path
    # 0 for a folder that is complete; else how long to wait for the next file, which is taken as whole when its size
    # did not change between two looks
    wait_s: float = 0.0
    poll_s: float = 0.2  # time between two looks
    sleep: Callable[[float], None] = time.sleep  # takes seconds
    _taken: set[str] = field(default_factory=set, init=False, repr=False)

    def __post_init__(self) -> None:
        require_number(self.wait_s, "wait_s", least=0.0)
        require_number(self.poll_s, "poll_s", above=0.0)
        self.folder = Path(self.folder)
        require(self.folder.is_dir(), f"there is no folder {self.folder}: give the one with the images of the camera")

    def take(self, request: ExposureRequest) -> Image | Failure:
        """Read the next image; the epoch and exposure come from the file, not from the request."""
        waited, sizes = 0.0, dict[str, int]()
        while True:
            path = self._next(sizes)
            if path is not None:
                self._taken.add(path.name)
                try:
                    return Image.open(path)
                except DataError as error:
                    return Failure(Reason.UNREADABLE_IMAGE, str(error))
            if waited >= self.wait_s:
                return Failure(Reason.NO_SIGNAL, f"{self.folder}: no further image came within {self.wait_s:g} s")
            self.sleep(self.poll_s)
            waited += self.poll_s

    def _next(self, sizes: dict[str, int]) -> Path | None:
        """First file that was not taken and, in a folder that is watched, has its size of the last look."""
        for path in sorted(self.folder.iterdir()):
            if path.name in self._taken or path.suffix.lower() not in IMAGE_SUFFIXES:
                continue
            size = path.stat().st_size
            if self.wait_s == 0.0 or sizes.get(path.name) == size:
                return path
            sizes[path.name] = size
            return None
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class TriggerPlan:
    """Order of two cameras, and how much later the second one starts."""

    primary: int  # 0 or 1: the camera with the longer exposure, which triggers the other
    delay_s: float  # from the start of the primary to that of the secondary, for the same middles


def trigger_plan(exposures_s: tuple[float, float]) -> TriggerPlan:
    """Plan a trigger that gives two exposures the same middle.

    Source: Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation (ODIN), section "Camera
    Triggers and Timetag Syncing".

    >>> trigger_plan((0.5, 0.002))
    TriggerPlan(primary=0, delay_s=0.249)
    """
    for exposure in exposures_s:
        require_number(exposure, "exposure_s", above=0.0)
    primary = 0 if exposures_s[0] >= exposures_s[1] else 1
    return TriggerPlan(primary=primary, delay_s=abs(exposures_s[0] - exposures_s[1]) / 2.0)


def take_pair(
    sources: tuple[CameraSource, CameraSource], et: float, exposures_s: tuple[float, float], *, within_s: float = 1e-3
) -> tuple[Image, Image] | Failure:
    """Take an image of each of two cameras at one time."""
    images = []
    for source, exposure in zip(sources, exposures_s, strict=True):
        image = source.take(ExposureRequest(et=et, exposure_s=exposure))
        if isinstance(image, Failure):
            return image
        images.append(image)
    first, second = images
    if first.et is None or second.et is None:
        return Failure(Reason.NO_EPOCH, f"{first.name}, {second.name}: a pair needs the epochs of both images")
    apart = abs(first.et - second.et)
    if apart > within_s:
        return Failure(Reason.REJECTED, f"{first.name}, {second.name}: {apart:.3g} s apart, {within_s:g} s are allowed")
    return first, second
