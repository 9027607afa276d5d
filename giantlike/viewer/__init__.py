"""Look into a run image by image, at the shell, in Python and in a browser."""

from giantlike.viewer.explain import explain
from giantlike.viewer.layers import layers_of
from giantlike.viewer.planes import backplanes_of
from giantlike.viewer.session import Session

__all__ = ["Session", "backplanes_of", "explain", "layers_of"]
