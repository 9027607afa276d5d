"""Dead rows and columns: found in front of a body, and nothing that optics can draw is taken for one."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.independent import Defects, EllipsoidBody, PinholeView, Pose, Psf, Recorder, record, render_body
from giantlike.processing.detection.dead_lines import dead_lines
from giantlike.processing.detection.frame_lines import FrameLines

BIAS_DN, NOISE_DN, SIZE = 100.0, 5.0, 96
RECORDER = Recorder(read_noise_e=NOISE_DN, bias_dn=BIAS_DN)


def signal(sun: tuple[float, float, float], psf_px: float = 0.7) -> Float:
    """A sphere 60 px wide in the middle."""
    view = PinholeView(4000.0, (47.5, 47.5), SIZE, SIZE)
    pose = Pose(np.array([0.0, 0.0, 1333.0]), Rotation.identity(), np.array(sun) / np.linalg.norm(sun))
    result: Float = render_body(EllipsoidBody(np.full(3, 10.0)), view, pose, psf=Psf(psf_px), peak_dn=2000.0)
    return result


def test_dead_lines_across_a_body_are_found_and_those_in_the_dark_are_not() -> None:
    defects = Defects(dead_columns=(40, 3), dead_rows=(50, 61))
    seen = record(signal((0.2, 0.1, -1.0)), np.random.default_rng(1), RECORDER, defects).pixels
    found = dead_lines(FrameLines.from_frame(seen, BIAS_DN), noise_dn=NOISE_DN)
    assert found is not None
    assert np.flatnonzero(found.all(axis=0)).tolist() == [40]
    assert np.flatnonzero(found.all(axis=1)).tolist() == [50, 61]


def test_a_limb_a_crescent_a_bright_line_and_a_narrow_shadow_are_no_dead_lines() -> None:
    full, crescent = signal((0.2, 0.1, -1.0)), signal((1.0, 0.0, 6.0), psf_px=0.4)
    bright, shadow = full.copy(), full.copy()
    bright[:, 30] += 3000.0
    blurred = np.exp(-0.5 * ((np.arange(SIZE) - 47.0) / 0.7) ** 2) / (0.7 * np.sqrt(2.0 * np.pi))
    shadow *= 1.0 - blurred[:, None]  # black and a pixel wide, through the optics
    for number, light in enumerate((full, crescent, bright, shadow, np.zeros((SIZE, SIZE)))):
        seen = record(light, np.random.default_rng(number), RECORDER).pixels
        assert dead_lines(FrameLines.from_frame(seen, BIAS_DN), noise_dn=NOISE_DN) is None
