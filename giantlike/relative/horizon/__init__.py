"""From the horizon of an ellipsoid to its position: the Christian-Robinson algorithm, the sigmoid fit, the ellipse fit."""
