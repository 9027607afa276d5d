"""From the horizon of an ellipsoid to its position: Christian-Robinson algorithm, sigmoid fit, ellipse fit."""
