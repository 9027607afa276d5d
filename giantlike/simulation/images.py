"""Images with truth: the light of a scene through a camera and its detector."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

from giantlike.camera import Camera
from giantlike.catalogs import StarCatalog
from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.image import Image
from giantlike.ray_tracing import Template
from giantlike.scene import Scene, TargetGeometry
from giantlike.simulation.detector import DetectorModel, Readout, Seed, Stream, expose
from giantlike.simulation.incident import SimulationOptions, incident_light
from giantlike.simulation.shot import Photometry, Shot, unexposed
from giantlike.simulation.stars import StarField


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimulatedImage(Value):
    """An image and the truth behind it.

    Parameters
    ----------
    image : Image
        Pixels uint16; carries the true attitude and observer state.
    shot : Shot
        How it was taken.
    bodies : mapping of str to TargetGeometry
        True apparent geometry at mid-exposure of every target that is seen in the frame, by name.
    templates : mapping of str to Template
        Those bodies as rendered at mid-exposure, noise-free, PSF in.
    stars : StarField
        Stars of which light falls on the frame and that no body hides, true places at mid-exposure.
    star_electrons : (n,) float64, electron
        Light of each.
    readout : Readout
        What is true of the pixels: the mean charge without noise, and what cosmic rays left.
    seed : int or tuple of int
        Of everything random.
    """

    image: Image
    shot: Shot
    bodies: Mapping[str, TargetGeometry]
    templates: Mapping[str, Template]
    stars: StarField = field(repr=False)
    star_electrons: Float = field(repr=False)
    readout: Readout = field(repr=False)
    seed: Seed


def simulate_image(
    shot: Shot,
    camera: Camera,
    scene: Scene | None,
    *,
    seed: Seed,
    catalog: StarCatalog | None = None,
    photometry: Photometry | None = None,
    detector: DetectorModel | None = None,
    options: SimulationOptions | None = None,
) -> SimulatedImage:
    """Take an image of a scene.

    Parameters
    ----------
    shot : Shot
    camera : Camera
        With its PSF; its detector gives gain, read noise, bias and saturation.
    scene : Scene or None
        True geometry; None: only stars.
    seed : int or tuple of int
        Equal seeds give equal images; each random effect has a stream of its own.
    catalog : StarCatalog, optional
        The sky; without it there are no stars.
    photometry : Photometry, optional
    detector : DetectorModel, optional
        What the detector does beyond that; by default there is only shot noise.
    options : SimulationOptions, optional

    Returns
    -------
    SimulatedImage

    Raises
    ------
    InputError
        The scene cannot tell where a target is or where the Sun stands, or the camera has no PSF.
    """
    light = incident_light(
        shot,
        camera,
        scene,
        Stream.RAYS.random(seed),
        catalog=catalog,
        photometry=photometry or Photometry(),
        options=options or SimulationOptions(),
    )
    readout = expose(light.electrons, shot.exposure_s, camera.detector, seed=seed, model=detector)
    return SimulatedImage(
        image=dataclasses.replace(unexposed(shot, camera), pixels=readout.pixels),
        shot=shot,
        bodies=light.bodies,
        templates=light.templates,
        stars=light.stars,
        star_electrons=light.star_electrons,
        readout=readout,
        seed=seed,
    )
