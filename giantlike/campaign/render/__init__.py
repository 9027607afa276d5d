"""``giantlike render``: the scene file, its checks, and the images made of it."""
