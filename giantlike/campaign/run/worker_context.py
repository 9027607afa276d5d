"""Data that every process of a run loads once: campaign, catalog, shapes and kernels."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from giantlike._system.reading import resolving
from giantlike.camera import Camera
from giantlike.campaign.calibration.solve import temperature_of
from giantlike.campaign.file.config import Campaign
from giantlike.catalogs import StarCatalog, StarTable, load_catalog
from giantlike.core.values import Value
from giantlike.image import Image
from giantlike.io.spice import SpiceKernels, load_kernels
from giantlike.processing.calibration_frames import CalibrationFrames
from giantlike.shapes import Shape
from giantlike.stars import StarNavigation

NETWORK_SHAPE = "[network]"  # name of the shape of the landmarks of a network among those of the targets


class WithoutStars:
    """A catalog without some stars in any field; the whole sky, for the stored patterns, keeps them."""

    def __init__(self, catalog: StarCatalog, rejected: Iterable[int]) -> None:
        self._catalog = catalog
        self._rejected = np.array(sorted(rejected), dtype=np.int64)

    @property
    def name(self) -> str:
        """Name of the catalog."""
        return self._catalog.name

    @property
    def band(self) -> str:
        """Photometric band of its magnitudes."""
        return self._catalog.band

    @property
    def version(self) -> str:
        """Version of the catalog, and the number of stars left out."""
        return f"{self._catalog.version}; {self._rejected.size} stars rejected"

    def cone(
        self, direction_inertial: ArrayLike, radius_rad: float, *, max_magnitude: float | None = None
    ) -> StarTable:
        """Return the stars within an angle of a direction, as :meth:`StarCatalog.cone` does."""
        stars = self._catalog.cone(direction_inertial, radius_rad, max_magnitude=max_magnitude)
        if radius_rad >= math.pi:
            return stars
        return stars.select(np.flatnonzero(~np.isin(stars.ids, self._rejected)))


@dataclass(frozen=True, slots=True, eq=False)
class Workbench(Value):
    """Campaign with catalog, shapes and kernels loaded, once per process."""

    campaign: Campaign
    navigation: StarNavigation | None
    shapes: dict[str, Shape]  # by target name, and that of the landmarks of a network
    kernels: SpiceKernels | None
    frames: CalibrationFrames | None = None  # applied to every image

    @classmethod
    def load(cls, campaign: Campaign, *, trusted: bool = False) -> Workbench:
        """Load catalog, shapes and kernels."""
        navigation = None
        if campaign.stars is not None:
            navigation = StarNavigation(
                campaign.camera,
                load_catalog(campaign.stars.catalog),
                campaign.stars.options,
                detection=campaign.stars.detection,
            )
        shapes = {target.name: target.load_shape() for target in campaign.targets}
        if campaign.network is not None:
            known = next(one for one in campaign.targets if one.name == campaign.network.target.name)
            same = known == campaign.network.target
            shapes[NETWORK_SHAPE] = shapes[known.name] if same else campaign.network.target.load_shape()
        for target in campaign.targets:
            target.limb.height_map()
        kernels = None if campaign.spice is None else load_kernels(campaign.spice.kernels, ".", trusted=trusted)
        frames = None
        if campaign.frames is not None:
            with resolving(campaign.path, "a campaign file"):
                frames = campaign.frames.load(rows=campaign.camera.rows, columns=campaign.camera.columns)
        return cls(campaign, navigation, shapes, kernels, frames)

    def with_camera(self, camera: Camera) -> Workbench:
        """Return the workbench for a calibrated camera: attitudes anywhere, to the magnitude of the calibration."""
        stars, navigation, setup = self.campaign.stars, self.navigation, self.campaign.calibration
        if stars is not None and navigation is not None:
            least = max(stars.options.min_snr, 0.0 if setup is None else setup.min_snr)
            options = replace(stars.options, lost_in_space=True, estimate_scale=False, min_snr=least)
            stars = replace(stars, options=options)
            navigation = StarNavigation(camera, navigation.catalog, stars.options, detection=stars.detection)
        return replace(self, campaign=replace(self.campaign, camera=camera, stars=stars), navigation=navigation)

    def with_warning(self, text: str) -> Workbench:
        """Return the workbench for a campaign with one more warning."""
        return replace(self, campaign=replace(self.campaign, warnings=(*self.campaign.warnings, text)))

    def for_image(self, image: Image) -> Workbench:
        """Return the workbench with the camera at the temperature of an image."""
        setup = self.campaign.calibration
        if setup is None or setup.temperature_keyword is None or self.campaign.camera.uncertainty is None:
            return self
        camera = self.campaign.camera
        model = camera.model.at_temperature(temperature_of(image, setup.temperature_keyword))
        return self.with_camera(replace(camera, model=model))

    def without_stars(self, rejected: frozenset[int]) -> Workbench:
        """Return the workbench for an image of which a user rejected stars."""
        navigation = self.navigation
        if navigation is None or not rejected:
            return self
        catalog = WithoutStars(navigation.catalog, rejected)
        less = StarNavigation(navigation.camera, catalog, navigation.options, detection=navigation.detection)
        return replace(self, navigation=less)

    def close(self) -> None:
        """Unload the kernels."""
        if self.kernels is not None:
            self.kernels.unload()
