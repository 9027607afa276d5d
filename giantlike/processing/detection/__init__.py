"""Point sources, streaks and particle tracks in an image: detection, centroids, noise, sequences of images."""
