"""From the lit limb of a body of any shape to its position: lines across the limb, and limb matching."""
