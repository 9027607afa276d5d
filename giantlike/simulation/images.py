"""Simulated images with their truth: the light of bodies and stars through a camera and its detector."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

from giantlike.camera import Camera
from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.image import Image
from giantlike.ray_tracing import Template
from giantlike.scene import TargetGeometry
from giantlike.simulation.detector import DetectorModel, Readout, Seed, Stream, expose
from giantlike.simulation.incident import SimulationOptions, Sources, incident_light
from giantlike.simulation.shot import Shot, make_black_image
from giantlike.simulation.stars import DetectorStars


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimulatedImage(Value):
    """A simulated image and its truth."""

    image: Image  # pixels uint16, with the true attitude and observer
    shot: Shot  # the exposure
    bodies: Mapping[str, TargetGeometry]  # true, apparent, at mid-exposure, of targets in the frame, by name
    templates: Mapping[str, Template]  # those bodies as rendered at mid-exposure, noise-free, PSF in
    stars: DetectorStars = field(repr=False)  # whose light falls on the frame, not hidden by bodies; true positions
    star_electrons: Float = field(repr=False)  # (n,), electron; light of each star
    readout: Readout = field(repr=False)  # mean charge without noise and charge of cosmic rays, pixel by pixel
    seed: Seed  # seed of everything random


def simulate_image(
    shot: Shot,
    camera: Camera,
    sources: Sources,
    *,
    seed: Seed,
    detector: DetectorModel | None = None,
    options: SimulationOptions | None = None,
) -> SimulatedImage:
    """Simulate an image of bodies and stars.

    Parameters
    ----------
    shot : Shot; the exposure
    camera : Camera; with its PSF; its detector gives gain, read noise, bias and saturation
    sources : Sources; bodies and stars
    seed : int or tuple of int; equal seeds give equal images; each random effect has a separate stream
    detector : DetectorModel, optional; further effects of the detector; by default there is only shot noise
    options : SimulationOptions, optional; sampling

    Raises
    ------
    InputError
        The scene does not determine the position of a target or the direction of the Sun, or the camera has no PSF.
    """
    rays = Stream.RAYS.random(seed)
    light = incident_light(shot, camera, sources, rays, options=options or SimulationOptions())
    readout = expose(light.electrons, shot.exposure_s, camera.detector, seed=seed, model=detector)
    return SimulatedImage(
        image=dataclasses.replace(make_black_image(shot, camera), pixels=readout.pixels),
        shot=shot,
        bodies=light.bodies,
        templates=light.templates,
        stars=light.stars,
        star_electrons=light.star_electrons,
        readout=readout,
        seed=seed,
    )
