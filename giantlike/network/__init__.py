"""Control networks: points, poses, and the rotation and size of a body, adjusted to measures in many images."""

from giantlike.network.adjust import adjust
from giantlike.network.isis import read_isis
from giantlike.network.options import NetworkOptions
from giantlike.network.photos import Photo, Tracks
from giantlike.network.result import NetworkFix
from giantlike.network.rotation import Rotating

__all__ = ["NetworkFix", "NetworkOptions", "Photo", "Rotating", "Tracks", "adjust", "read_isis"]
