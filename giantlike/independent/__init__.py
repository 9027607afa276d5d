"""Independent truth for tests, benchmarks and replays: bodies, light, stars, detector and flights in numpy alone.

``orbit`` determines orbits from observables files, as a user's program would.

Nothing here imports another module of giantlike (import-linter checks it), and no formula was copied from one: an
error that an estimator shares with the renderer of its templates shows only beside images that come from elsewhere.
Pixels and axes are those of the project:
(0, 0) is the center of the first pixel, camera +x along columns, +y along rows, +z boresight.
"""

from giantlike.independent.bodies import Body, EllipsoidBody, ReliefBody, facet_mesh
from giantlike.independent.fields import SphereField, bumps, craters, rough, tabulate
from giantlike.independent.haze import Haze, hazy_sphere
from giantlike.independent.laws import LAWS, Law
from giantlike.independent.light import Motion, aberrated, apparent_disk, apparent_geometry, unaberrated
from giantlike.independent.psf import Psf
from giantlike.independent.record import Defects, Recorded, Recorder, background, record
from giantlike.independent.render import Pose, Sampling, render_body
from giantlike.independent.sky import StarField, random_stars, star_image
from giantlike.independent.views import PinholeView

__all__ = [
    "LAWS",
    "Body",
    "Defects",
    "Haze",
    "EllipsoidBody",
    "Law",
    "Motion",
    "PinholeView",
    "Pose",
    "Psf",
    "Recorded",
    "Recorder",
    "ReliefBody",
    "Sampling",
    "SphereField",
    "StarField",
    "aberrated",
    "apparent_disk",
    "apparent_geometry",
    "background",
    "bumps",
    "craters",
    "facet_mesh",
    "hazy_sphere",
    "random_stars",
    "record",
    "render_body",
    "rough",
    "star_image",
    "tabulate",
    "unaberrated",
]
